// A document on the server: each change is sent immediately, in order, and can be undone.

import { getJson, post } from "./api.js";
import { say, saved } from "./messages.js";

export class Edits {
  // `key`: its name in requests; `reread`: gets {revision, [key]} from the server; `changed`: called after each change.
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
        say(`Another tab or program changed the ${this.name.toLowerCase()}.`, "bad", {
          "Load that version": () => this.loadStored(),
          "Keep mine": () => this.keepMine(),
        });
      } else if (error.status === 422) {
        say(`${error.message} The change was undone.`);
        await this.loadStored();
      } else {
        say(error.message, "bad", { "Try again": () => this.keepMine() });
      }
    }
  }

  async loadStored() {
    try {
      const stored = await this.reread(getJson);
      this.take(stored.revision, stored[this.key]);
      this.past = [];
      this.future = [];
      saved(`${this.name} saved`);
      this.changed(true);
    } catch (error) {
      say(error.message, "bad", { "Try again": () => this.loadStored() });
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

  // True if the server does not have the latest value.
  get dirty() {
    return this.value !== this.stored;
  }
}
