// The page: the shown camera and frame, and the keys.

import { getJson, Images } from "./api.js";
import { MasksMode } from "./masks.js";
import { say } from "./messages.js";
import { Timeline } from "./timeline.js";
import { View } from "./view.js";

const find = (id) => document.getElementById(id);
const AHEAD = 6; // frames to fetch in advance

class App {
  constructor(state) {
    this.state = state;
    this.camera = state.cameras[0].name;
    this.frame = 0;
    this.frames = state.frames;
    this.images = new Images();
    this.view = new View(find("view"));
    this.timeline = new Timeline({ go: (frame) => this.go(frame), bars: () => this.masks?.bars() ?? [] });
    this.timeline.set(state.frames, state.frame_rate);
    this.masks = this.view.mode = new MasksMode(this);
    find("name").textContent = state.name;
    find("name").title = state.folder;
    document.title = `${state.name} – neuspring annotate`;
    find("cameras").replaceChildren(...state.cameras.map(({ name }) => {
      const button = document.createElement("button");
      button.textContent = `camera ${name}`;
      button.onclick = () => this.go(this.frame, name);
      return button;
    }));
    find("show-help").onclick = () => find("help").showModal();
    find("overlay").onclick = () => this.toggleOverlay();
    // Release the focus of a clicked button, so that Space plays instead of pressing it again.
    document.addEventListener("click", (event) => event.detail && event.target.closest("button")?.blur());
    window.addEventListener("keydown", (event) => this.key(event));
    window.addEventListener("beforeunload", (event) => {
      if (this.masks.edits.dirty) event.preventDefault();
    });
  }

  async start() {
    this.masks.start(this.state.masks);
    find("legend").replaceChildren(...this.masks.legend().map(([color, text]) => {
      const entry = document.createElement("span");
      const swatch = document.createElement("i");
      swatch.className = "swatch";
      swatch.style.background = color;
      entry.append(swatch, text);
      return entry;
    }));
    await this.go(this.frame);
    document.body.dataset.ready = "yes";
  }

  cameras() {
    return this.state.cameras.map((camera) => camera.name);
  }

  size(name = this.camera) {
    return this.state.cameras.find((camera) => camera.name === name);
  }

  // Show a frame; resolves when it is drawn. The last of several calls wins.
  async go(frame, camera = this.camera) {
    const moved = camera !== this.camera || frame !== this.frame;
    this.camera = camera;
    this.frame = Math.min(Math.max(frame, 0), this.frames - 1);
    if (moved) this.masks.left();
    const { width, height, missing } = this.size();
    this.view.setSize(width, height);
    for (const [k, name] of this.cameras().entries()) find("cameras").children[k].setAttribute("aria-pressed", name === camera);
    this.timeline.show(this.frame);
    this.masks.refresh();
    this.refreshOverlay();
    const asked = (this.asked = (this.asked ?? 0) + 1);
    this.refreshHint();
    if (missing.includes(this.frame)) {
      this.view.frame = this.view.overlay = null;
      this.hint("This camera did not record this frame.");
      this.view.draw();
      return;
    }
    try {
      const [picture, overlay] = await Promise.all([this.picture(this.frame), this.masks.overlay(camera, this.frame)]);
      if (asked !== this.asked) return;
      this.view.frame = picture;
      this.view.overlay = overlay;
      this.view.draw();
    } catch (error) {
      if (asked === this.asked) say(error.message);
      this.timeline.stop();
    }
    if (this.timeline.playing) this.ahead();
  }

  picture(frame) {
    const { width, height } = this.size();
    return this.images.get(`/api/color/${this.camera}/${frame}`, width * height);
  }

  ahead() {
    const { missing } = this.size();
    for (let next = this.frame + 1; next <= Math.min(this.frame + AHEAD, this.frames - 1); next += 1) {
      if (missing.includes(next)) continue;
      this.picture(next).catch(() => {});
      this.masks.overlay(this.camera, next);
    }
  }

  // Redraw the overlay of this frame.
  showMasks() {
    return this.go(this.frame);
  }

  toggleOverlay() {
    this.masks.showOverlay = !this.masks.showOverlay;
    this.refreshOverlay();
  }

  refreshOverlay() {
    this.view.showOverlay = this.masks.showOverlay;
    find("overlay").setAttribute("aria-pressed", this.masks.showOverlay);
    find("overlay-text").textContent = this.masks.source(this.camera, this.frame) ?? "no";
    this.view.draw();
  }

  refreshHint() {
    this.hint(this.masks?.hint() ?? "");
  }

  hint(text) {
    find("hint").textContent = text;
  }

  chip(frame, text, kind = "") {
    const button = document.createElement("button");
    button.textContent = text;
    button.className = kind;
    button.classList.toggle("here", frame === this.frame);
    button.dataset.frame = frame;
    button.onclick = () => this.go(frame);
    return button;
  }

  key(event) {
    if (find("help").open || (event.target.matches?.("input[type=text]") && event.key !== "Escape")) return;
    const step = event.shiftKey ? 10 : 1;
    const key = event.key.toLowerCase();
    const move = (frame) => {
      this.timeline.stop();
      this.go(frame);
    };
    if ((event.ctrlKey || event.metaKey) && key === "z") event.shiftKey ? this.masks.edits.redo() : this.masks.edits.undo();
    else if (event.ctrlKey || event.metaKey || event.altKey) return;
    else if (key === "arrowleft") move(this.frame - step);
    else if (key === "arrowright") move(this.frame + step);
    else if (key === "home") move(0);
    else if (key === "end") move(this.frames - 1);
    else if (key === " ") this.timeline.toggle();
    else if (key === "k") this.go(this.frame, this.cameras()[(this.cameras().indexOf(this.camera) + 1) % this.cameras().length]);
    else if (key === "f") this.view.fit();
    else if (key === "m") this.toggleOverlay();
    else if (key === "?") find("help").showModal();
    else if (!this.masks.key(event)) return;
    event.preventDefault();
  }
}

try {
  const app = new App(await getJson("/api/state"));
  window.annotate = app; // for tests and the console
  await app.start();
} catch (error) {
  say(error.message);
  console.error(error);
}
