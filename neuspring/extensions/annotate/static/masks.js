// Annotations of frames, previews, carrying, saving.

import { getJson, post, postForImage } from "./api.js";
import { doubtColor, HIGH, worst } from "./doubt.js";
import { Edits } from "./edits.js";
import { guard, say } from "./messages.js";
import { COLORS, drawMark } from "./paint.js";
import { Pen } from "./pen.js";
import { row, swatch } from "./rows.js";

const find = (id) => document.getElementById(id);
const KINDS = { b: "box", c: "click", s: "scribble", p: "polygon" };
const LABELS = { 1: "object", 2: "hand", 3: "ignore", 4: "person" };
const HINTS = {
  box: "Drag a box around the {label}.",
  click: "Click on the {label}.",
  scribble: "Drag a line over the {label}.",
  polygon: "Click corners around the {label}. Close it with Enter or a double click.",
};

export class MasksMode {
  constructor(app) {
    this.app = app;
    this.showOverlay = true;
    this.pen = new Pen(this);
    for (const name of ["down", "move", "up", "hover", "double"]) this[name] = (...values) => this.pen[name](...values);
    this.chosen = -1;
    this.preview = null;
    this.results = { job: { state: "idle" }, carried: {}, saved: {} };
    this.version = 0;
    this.edits = new Edits({
      key: "marks",
      path: "/api/marks",
      name: "Annotations",
      reread: (get) => get("/api/masks"),
      changed: (sent) => this.changed(sent),
    });
    for (const button of find("labels").children) button.onclick = () => this.setLabel(button.dataset.label);
    for (const button of find("tools").children) button.onclick = () => this.setTool(button.dataset.tool);
    find("radius").oninput = () => this.setRadius(Number(find("radius").value));
    find("undo").onclick = () => this.edits.undo();
    find("redo").onclick = () => this.edits.redo();
    find("copy").onclick = () => this.copyLast();
    find("carry").onclick = guard(() => this.carry([app.camera]));
    find("carry-all").onclick = guard(() => this.carry(app.cameras().filter((name) => this.marksOf(name).length)));
    find("stop").onclick = guard(() => post("/api/stop"));
    find("save-masks").onclick = guard(() => this.save());
    this.setLabel("object");
    this.setTool("box");
    this.setRadius(3);
  }

  start(state) {
    this.edits.take(state.revision, state.marks);
    this.results = state;
    if (state.job.state === "running") this.watch();
  }

  // Annotations.
  marksOf(camera = this.app.camera) {
    return this.edits.value?.cameras[camera] ?? [];
  }

  here() {
    return this.marksOf().filter((mark) => mark.frame === this.app.frame);
  }

  set(marks) {
    const cameras = { ...this.edits.value.cameras, [this.app.camera]: marks };
    if (!marks.length) delete cameras[this.app.camera];
    this.edits.change({ ...this.edits.value, cameras });
  }

  add(kind, points) {
    this.app.timeline.stop();
    this.set([...this.marksOf(), { frame: this.app.frame, label: this.label, kind, points, radius: this.radius }]);
  }

  remove(mark) {
    this.chosen = -1;
    this.set(this.marksOf().filter((other) => other !== mark));
  }

  removeChosen() {
    const marks = this.here();
    const mark = marks[this.chosen] ?? marks.at(-1);
    if (mark) this.remove(mark);
  }

  copyLast() {
    const before = Math.max(...this.marksOf().map((mark) => mark.frame).filter((frame) => frame < this.app.frame));
    if (!Number.isFinite(before)) return;
    const copies = this.marksOf().filter((mark) => mark.frame === before).map((mark) => ({ ...mark, frame: this.app.frame }));
    this.set([...this.marksOf(), ...copies]);
  }

  changed(sent = false) {
    this.refresh();
    this.preview = null;
    if (!sent) this.app.showMasks();
    else if (find("live").checked && this.here().some((mark) => ["object", "hand"].includes(mark.label))) this.showPreview(false);
    else this.app.showMasks();
    if (sent) this.reread();
  }

  // Results of the server.
  reread = guard(async () => {
    this.results = await getJson("/api/masks");
    this.refresh();
  });

  async showPreview(loud = true) {
    const { camera, frame } = this.app;
    try {
      await this.edits.sending;
      const image = await postForImage("/api/preview", { camera, frame });
      if (camera !== this.app.camera || frame !== this.app.frame) return;
      this.preview = { camera, frame, image };
    } catch (error) {
      if (loud || error.status !== 422) say(error.message);
      else this.app.hint(error.message);
      this.preview = null;
    }
    await this.app.showMasks();
  }

  async overlay(camera, frame) {
    const source = this.source(camera, frame);
    if (!source) return null;
    if (source === "previewed") return this.preview.image;
    const { width, height } = this.app.size(camera);
    const version = source === "carried" ? this.version : `${this.version}s`;
    return this.app.images.get(`/api/overlay/${source}/${camera}/${frame}?${version}`, width * height).catch(() => null);
  }

  // The newest masks of a frame: previewed, carried, saved, or null.
  source(camera, frame) {
    if (this.preview?.camera === camera && this.preview.frame === frame) return "previewed";
    if (this.results.carried[camera]) return "carried";
    return this.results.saved[camera] ? "saved" : null;
  }

  async carry(cameras) {
    await this.edits.sending;
    if (!cameras.length) return say("Annotate the object in a frame first: draw a box around it.");
    this.results.job = await post("/api/carry", { cameras });
    this.refresh();
    return this.watch();
  }

  async watch() {
    if (this.watching) return;
    this.watching = true;
    let job;
    try {
      do {
        job = await getJson("/api/job");
        this.results.job = job;
        this.progress(job);
        await new Promise((done) => setTimeout(done, 250));
        // Not job.state: another job may have started during the wait.
      } while (this.results.job.state === "running");
    } catch (error) {
      say(error.message, "bad", { "Try again": () => this.watch() });
    } finally {
      this.watching = false;
    }
    this.version += 1;
    this.preview = null;
    await this.reread();
    await this.app.showMasks();
    if (this.results.job.state === "running") return this.watch();
    if (job?.state === "done") say(job.message, "good");
    else if (job && job.state !== "running") say(job.message);
  }

  async save() {
    const { cameras } = await post("/api/masks/save");
    this.version += 1;
    await this.reread();
    say(`Saved masks of camera ${cameras.join(", ")}.`, "good");
  }

  // The panel.
  setLabel(label) {
    this.label = label;
    for (const button of find("labels").children) button.setAttribute("aria-pressed", button.dataset.label === label);
    this.app.refreshHint?.();
  }

  setTool(tool) {
    this.tool = tool;
    this.pen.drop();
    for (const button of find("tools").children) button.setAttribute("aria-pressed", button.dataset.tool === tool);
    this.app.refreshHint?.();
  }

  setRadius(radius) {
    this.radius = radius;
    find("radius").value = radius;
    find("radius-value").textContent = `${radius} px`;
    this.app.view?.draw();
  }

  hint() {
    return HINTS[this.tool].replace("{label}", this.label === "ignore" ? "area to ignore" : this.label);
  }

  refresh() {
    const { app, results } = this;
    const rows = this.here().map((mark, index) => this.row(mark, index));
    find("marks").replaceChildren(...rows);
    find("marks").dataset.empty = "none yet";
    const frames = [...new Set(this.marksOf().map((mark) => mark.frame))].sort((a, b) => a - b);
    find("marked").replaceChildren(...frames.map((frame) => app.chip(frame, `frame ${frame}`)));
    find("undo").disabled = !this.edits.past.length;
    find("redo").disabled = !this.edits.future.length;
    find("copy").disabled = !frames.some((frame) => frame < app.frame);
    const running = results.job.state === "running";
    find("carry").disabled = find("carry-all").disabled = running;
    this.progress(results.job);
    const carried = results.carried[app.camera];
    find("stale").hidden = !carried?.stale || running;
    find("doubtful").replaceChildren(...worst(this.doubt()).map(({ frame, doubt }) =>
      app.chip(frame, `${frame} · ${Math.round(100 * doubt)} %`, doubt > HIGH ? "high" : "mid")));
    find("doubtful").dataset.empty = this.doubt().length ? "none: all frames are certain" : "available after masks are carried";
    const unsaved = Object.keys(results.carried).filter((name) => !results.carried[name].saved);
    find("save-masks").disabled = running || !unsaved.length;
    const list = (names) => names.join(", ");
    find("masks-note").textContent =
      (unsaved.length ? `Not saved yet: camera ${list(unsaved)}. ` : "") +
      (Object.keys(results.saved).length ? `The capture has masks of camera ${list(Object.keys(results.saved))}.` : "The capture has no masks.");
    app.timeline.draw();
    app.view.draw();
  }

  row(mark, index) {
    return row({
      sign: swatch(mark.label),
      text: `${mark.label}, ${mark.kind}`,
      chosen: index === this.chosen,
      remove: () => this.remove(mark),
      pick: () => {
        this.chosen = this.chosen === index ? -1 : index;
        this.refresh();
      },
    });
  }

  progress(job) {
    find("progress").hidden = job.state !== "running";
    if (job.state !== "running") return;
    const share = job.total ? job.done / job.total : 0;
    find("bar").value = share;
    const text = `${job.what}: ${Math.floor(100 * share)} % in ${Math.floor(job.seconds)} s`;
    find("progress-text").textContent = job.what ? text : "starting";
  }

  // Doubt of all frames of the shown masks.
  doubt() {
    return this.results.carried[this.app.camera]?.doubt ?? this.results.saved[this.app.camera] ?? [];
  }

  bars() {
    const bars = this.doubt().map((doubt, frame) => ({ frame, height: Math.max(0.8 * doubt, 0.06), color: doubtColor(doubt) }));
    for (const mark of this.marksOf()) bars.push({ frame: mark.frame, height: 1, color: COLORS[mark.label] });
    return bars;
  }

  legend() {
    return [...Object.entries(COLORS).map(([label, color]) => [color, label]), [doubtColor(1), "doubt"]];
  }

  key(event) {
    const key = event.key.toLowerCase();
    if (KINDS[key]) this.setTool(KINDS[key]);
    else if (LABELS[key]) this.setLabel(LABELS[key]);
    else if (key === "v") this.showPreview();
    else if (this.pen.key(key)) return true;
    else if (key === "delete" || key === "backspace") this.removeChosen();
    else if (key === "d") this.nextDoubtful();
    else return false;
    this.app.view.draw();
    return true;
  }

  nextDoubtful() {
    const list = worst(this.doubt());
    if (!list.length) return this.app.hint("There is no doubtful frame.");
    const next = (list.findIndex((one) => one.frame === this.app.frame) + 1) % list.length;
    return this.app.go(list[next].frame);
  }

  left() {
    this.pen.drop();
    this.chosen = -1;
    this.preview = null;
  }

  paint(context, view) {
    this.here().forEach((mark, index) => drawMark(context, view, mark, index === this.chosen));
    this.pen.paint(context, view);
  }
}
