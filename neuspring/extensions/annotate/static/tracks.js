// The tracks mode: a point is clicked in a few frames, the server follows it in between.

import { getJson, post } from "./api.js";
import { Edits } from "./edits.js";
import { guard, say } from "./messages.js";
import { drawPoint, drawWay, pointColor } from "./paint.js";
import { dot, row } from "./rows.js";

const find = (id) => document.getElementById(id);
const NEAR = 9; // CSS pixels
const WAY = 12; // frames of the way that are drawn

export class TracksMode {
  constructor(app) {
    this.app = app;
    this.showOverlay = false; // masks hide what is clicked on
    this.chosen = -1;
    this.version = 0;
    this.followed = new Map();
    this.tracksExist = false;
    this.edits = new Edits({
      key: "annotations",
      path: "/api/clicks",
      name: "Clicks",
      reread: (get) => get("/api/clicks"),
      changed: (sent) => {
        this.refresh();
        if (sent) this.watch();
      },
    });
    find("new-point").onclick = () => this.newPoint();
    find("undo-click").onclick = () => this.edits.undo();
    find("hide").onclick = () => this.hide();
    find("remove-click").onclick = () => this.removeClick();
    find("point-name").onchange = () => this.rename(find("point-name").value.trim());
    find("save-tracks").onclick = guard(() => this.save(false));
  }

  start(state) {
    this.edits.take(state.revision, state.annotations);
    this.tracksExist = state.tracks_exist;
    this.chosen = this.points.length ? 0 : -1;
    this.watch();
  }

  get points() {
    return this.edits.value?.points ?? [];
  }

  get point() {
    return this.points[this.chosen];
  }

  clicks(point = this.point) {
    return point?.clicks[this.app.camera] ?? [];
  }

  clickHere(point = this.point) {
    return this.clicks(point).find((click) => click.frame === this.app.frame);
  }

  placeHere(point) {
    const click = this.clickHere(point);
    if (click) return click.hidden ? null : [click.x, click.y];
    return this.followed.get(point.name)?.trails[this.app.camera]?.[this.app.frame] ?? null;
  }

  // Changes.
  setPoint(index, point) {
    this.edits.change({ ...this.edits.value, points: this.points.map((other, k) => (k === index ? point : other)) });
  }

  setClicks(clicks) {
    const all = { ...this.point.clicks, [this.app.camera]: clicks.sort((a, b) => a.frame - b.frame) };
    if (!clicks.length) delete all[this.app.camera];
    this.setPoint(this.chosen, { ...this.point, clicks: all });
  }

  setClick(click) {
    this.setClicks([...this.clicks().filter((other) => other.frame !== this.app.frame), { frame: this.app.frame, ...click }]);
  }

  newPoint() {
    const names = this.points.map((point) => point.name);
    let number = this.points.length + 1;
    while (names.includes(`point ${number}`)) number += 1;
    this.edits.change({ ...this.edits.value, points: [...this.points, { name: `point ${number}`, clicks: {} }] });
    this.chosen = this.points.length - 1;
    this.refresh();
  }

  removePoint(index) {
    this.edits.change({ ...this.edits.value, points: this.points.filter((_, k) => k !== index) });
    this.chosen = Math.min(this.chosen, this.points.length - 1);
    this.refresh();
  }

  rename(name) {
    if (!this.point || !name || name === this.point.name) return this.refresh();
    if (this.points.some((point) => point.name === name)) {
      say(`There is a point named ${name} already.`);
      return this.refresh();
    }
    return this.setPoint(this.chosen, { ...this.point, name });
  }

  hide() {
    if (!this.point) return;
    if (this.clickHere()?.hidden) this.removeClick();
    else this.setClick({ hidden: true });
  }

  removeClick() {
    if (this.clickHere()) this.setClicks(this.clicks().filter((click) => click.frame !== this.app.frame));
  }

  // Results of the server.
  async watch() {
    this.again = true;
    if (this.watching) return;
    this.watching = true;
    try {
      for (let busy = true; busy || this.again; ) {
        this.again = false;
        const answer = await getJson(`/api/tracks/${this.version}`);
        ({ busy } = answer);
        this.busy = busy;
        this.version = answer.version;
        if (answer.points) this.followed = new Map(answer.points.map((point) => [point.name, point]));
        if (answer.failure) say(answer.failure);
        this.refresh();
        if (busy) await new Promise((done) => setTimeout(done, 200));
      }
    } catch (error) {
      say(error.message, "bad", { "Try again": () => this.watch() });
    } finally {
      this.watching = false;
    }
  }

  async save(replace) {
    await this.edits.sending;
    try {
      const { points } = await post("/api/tracks/save", { replace });
      this.tracksExist = true;
      this.refresh();
      say(`Saved ${points} ${points === 1 ? "track" : "tracks"} to tracks.json.`, "good");
    } catch (error) {
      if (error.status !== 428) throw error;
      say(error.message, "bad", { Replace: guard(() => this.save(true)) });
    }
  }

  // The panel.
  hint() {
    if (!this.point) return "Click on a point of the object that is easy to find again.";
    if (this.clickHere()?.hidden) return `${this.point.name} is hidden in this camera from here on.`;
    const places = this.placeHere(this.point);
    return `Click where ${this.point.name} is${places ? ", if the ring is not on it" : ""}.`;
  }

  refresh() {
    const { app, point } = this;
    find("points").replaceChildren(...this.points.map((one, index) => this.row(one, index)));
    find("points").dataset.empty = "none yet";
    find("point-name").value = point?.name ?? "";
    find("point-name").disabled = find("hide").disabled = !point;
    find("hide").setAttribute("aria-pressed", Boolean(this.clickHere()?.hidden));
    find("remove-click").disabled = !this.clickHere();
    find("undo-click").disabled = !this.edits.past.length;
    find("clicks").replaceChildren(...this.clicks().map((click) => app.chip(click.frame, click.hidden ? `${click.frame} hidden` : click.frame)));
    find("clicks").dataset.empty = point ? "no click in this camera yet" : "";
    const world = this.followed.get(point?.name)?.world[app.frame];
    find("world").textContent = !point ? "" : world ? `x ${world[0].toFixed(3)}, y ${world[1].toFixed(3)}, z ${world[2].toFixed(3)} m`
      : "not in the world in this frame";
    const notes = [...this.followed.values()].flatMap((one) => one.notes);
    find("notes").replaceChildren(...notes.map((note) => this.noteRow(note)));
    find("notes").dataset.empty = this.busy ? "following …" : this.points.length ? "nothing" : "";
    find("save-tracks").disabled = !this.points.length || this.busy;
    find("tracks-note").textContent = this.busy ? "Following the points …" : this.tracksExist ? "The capture has tracks.json."
      : "The capture has no tracks.json.";
    app.refreshHint();
    app.timeline.draw();
    app.view.draw();
  }

  row(point, index) {
    const world = this.followed.get(point.name)?.world ?? [];
    return row({
      sign: dot(pointColor(index)),
      text: point.name,
      count: `${world.filter(Boolean).length} of ${this.app.frames} frames`,
      chosen: index === this.chosen,
      remove: () => this.removePoint(index),
      pick: () => {
        this.chosen = index;
        this.refresh();
      },
    });
  }

  noteRow(note) {
    const index = this.points.findIndex((point) => point.name === note.point);
    const frames = note.first === note.last ? `frame ${note.first}` : `frames ${note.first}–${note.last}`;
    return row({
      sign: dot(pointColor(index)),
      text: `${note.point}, ${note.camera === null ? "" : `camera ${note.camera}, `}${frames}: ${note.text}`,
      pick: () => {
        this.chosen = this.points.findIndex((point) => point.name === note.point);
        this.app.go(note.frame, note.camera ?? this.app.camera);
      },
    });
  }

  bars() {
    const bars = [];
    const trail = this.followed.get(this.point?.name)?.trails[this.app.camera];
    trail?.forEach((place, frame) => bars.push({ frame, height: 0.45, color: place ? "#3d8b75" : "#4a3030" }));
    for (const note of this.followed.get(this.point?.name)?.notes ?? []) {
      const bar = { frame: note.first, last: note.last, height: 0.45, color: "#e0b03c" };
      if (note.camera === null || note.camera === this.app.camera) bars.push(bar);
    }
    for (const click of this.clicks()) {
      bars.push({ frame: click.frame, height: 1, color: click.hidden ? "#8d97a3" : pointColor(this.chosen) });
    }
    return bars;
  }

  legend() {
    return [["#3d8b75", "followed"], ["#4a3030", "not seen"], ["#e0b03c", "to look at"], ["#8d97a3", "hidden from here"]];
  }

  // The pointer.
  down(point) {
    const reach = NEAR / this.app.view.scale;
    const near = this.points.findIndex((other, index) => {
      const place = index === this.chosen ? null : this.placeHere(other);
      return place && Math.hypot(place[0] - point[0], place[1] - point[1]) < reach;
    });
    if (near >= 0) {
      this.chosen = near;
      this.refresh();
      return;
    }
    this.app.timeline.stop();
    if (!this.point) this.newPoint();
    this.dragged = null;
    this.setClick({ x: point[0], y: point[1] });
    this.grabbed = true;
  }

  move(point) {
    if (!this.grabbed) return;
    this.dragged = point;
    this.app.view.draw();
  }

  up() {
    if (this.grabbed && this.dragged) this.setClick({ x: this.dragged[0], y: this.dragged[1] });
    this.grabbed = false;
    this.dragged = null;
  }

  key(event) {
    const key = event.key.toLowerCase();
    if (key === "n") this.newPoint();
    else if (key === "h") this.hide();
    else if (key === "delete" || key === "backspace") this.removeClick();
    else if (key === "[") this.jump(-1);
    else if (key === "]") this.jump(1);
    else return false;
    return true;
  }

  jump(step) {
    const frames = this.clicks().map((click) => click.frame);
    const next = step > 0 ? frames.find((frame) => frame > this.app.frame) : frames.findLast((frame) => frame < this.app.frame);
    if (next !== undefined) this.app.go(next);
  }

  left() {
    this.grabbed = false;
    this.dragged = null;
  }

  paint(context, view) {
    this.points.forEach((point, index) => {
      const color = pointColor(index);
      const trail = this.followed.get(point.name)?.trails[this.app.camera];
      if (trail) drawWay(context, view, trail.slice(Math.max(this.app.frame - WAY, 0), this.app.frame + 1), color);
      const chosen = index === this.chosen;
      const place = (chosen && this.dragged) || this.placeHere(point);
      if (place) drawPoint(context, view, place, color, { chosen, clicked: Boolean(this.clickHere(point)), name: point.name });
    });
  }
}
