// A document that is kept on the server: every change is sent at once, in order, and can be undone.

import { getJson, post } from "./api.js";
import { say, saved } from "./messages.js";

export class Edits {
  // `key`: its name in requests; `reread`: gives {revision, [key]} as it is on the server; `changed`: called after every change.
  constructor({ key, path, reread, changed, name }) {
    Object.assign(this, { key, path, reread, changed, name });
    this.past = [];
    this.future = [];
    this.sending = Promise.resolve();
    this.waiting = 0;
  }

  take(revision, value) {
    this.revision = revision;
    this.value = this.stored = value;
  }

  change(value) {
    this.past.push(this.value);
    if (this.past.length > 200) this.past.shift();
    this.future = [];
    this.put(value);
  }

  undo() {
    if (!this.past.length) return;
    this.future.push(this.value);
    this.put(this.past.pop());
  }

  redo() {
    if (!this.future.length) return;
    this.past.push(this.value);
    this.put(this.future.pop());
  }

  put(value) {
    this.value = value;
    this.waiting += 1;
    saved("saving …");
    this.sending = this.sending.then(() => this.send(value));
    this.changed();
  }

  async send(value) {
    this.waiting -= 1;
    if (this.waiting > 0) return; // a newer value follows
    try {
      const answer = await post(this.path, { revision: this.revision, [this.key]: value });
      this.revision = answer.revision;
      this.stored = value;
      if (!this.waiting) saved(`${this.name} saved`);
      this.changed(true);
    } catch (error) {
      saved(`${this.name} NOT saved`);
      if (error.status === 409) {
        say(`${this.name} changed in another tab or program.`, "bad", {
          "Take theirs": () => this.takeTheirs(),
          "Keep mine": () => this.keepMine(),
        });
      } else if (error.status === 422) {
        say(`${error.message} The change was taken back.`);
        await this.takeTheirs();
      } else {
        say(error.message, "bad", { "Try again": () => this.keepMine() });
      }
    }
  }

  async takeTheirs() {
    try {
      const theirs = await this.reread(getJson);
      this.take(theirs.revision, theirs[this.key]);
      this.past = [];
      this.future = [];
      saved(`${this.name} saved`);
      this.changed(true);
    } catch (error) {
      say(error.message, "bad", { "Try again": () => this.takeTheirs() });
    }
  }

  async keepMine() {
    try {
      this.revision = (await this.reread(getJson)).revision;
      this.put(this.value);
    } catch (error) {
      say(error.message, "bad", { "Try again": () => this.keepMine() });
    }
  }

  // Whether the server lacks something: it was not sent yet, or could not be kept.
  get dirty() {
    return this.value !== this.stored;
  }
}
