// Drawing an annotation with the pointer: box, click, scribble or polygon.

import { drawMark } from "./paint.js";

const NEAR = 9; // distance from a polygon's first corner at which a click closes it, CSS pixels

export class Pen {
  // `mode` has tool, label, radius, add(kind, points) and the page as app.
  constructor(mode) {
    this.mode = mode;
    this.drawing = null;
    this.pointer = null;
  }

  get app() {
    return this.mode.app;
  }

  get polygon() {
    return this.drawing?.kind === "polygon";
  }

  drop() {
    this.drawing = null;
    this.app.view?.draw();
  }

  down(point) {
    const { tool } = this.mode;
    if (tool === "click") this.mode.add("click", [point]);
    else if (tool === "polygon") {
      const first = this.drawing?.points[0];
      const near = first && Math.hypot(first[0] - point[0], first[1] - point[1]) * this.app.view.scale < NEAR;
      if (near && this.drawing.points.length > 2) this.close();
      else this.drawing = { kind: "polygon", points: [...(this.drawing?.points ?? []), point] };
    } else this.drawing = { kind: tool, points: tool === "box" ? [point, point] : [point] };
    this.app.view.draw();
  }

  move(point) {
    if (!this.drawing || this.polygon) return;
    const { kind, points } = this.drawing;
    if (kind === "box") points[1] = point;
    else if (Math.hypot(points.at(-1)[0] - point[0], points.at(-1)[1] - point[1]) >= 1) points.push(point);
    this.app.view.draw();
  }

  up() {
    if (!this.drawing || this.polygon) return;
    const { kind, points } = this.drawing;
    this.drawing = null;
    if (kind === "box" && Math.min(Math.abs(points[0][0] - points[1][0]), Math.abs(points[0][1] - points[1][1])) < 2) {
      this.app.hint("The box is too small. Drag from corner to corner.");
    } else this.mode.add(kind, points);
    this.app.view.draw();
  }

  hover(point) {
    this.pointer = point;
    this.app.view.draw();
  }

  double() {
    if (this.polygon) this.close();
  }

  close() {
    // A double click adds its corner twice; remove the copy.
    const corners = this.drawing.points.filter(([x, y], k, all) => !k || Math.hypot(x - all[k - 1][0], y - all[k - 1][1]) > 0.5);
    this.drawing = null;
    if (corners.length < 3) this.app.hint("A polygon needs at least three corners.");
    else this.mode.add("polygon", corners);
    this.app.view.draw();
  }

  key(key) {
    if (key === "enter" && this.polygon) this.close();
    else if (key === "escape") this.drop();
    else if (key === "backspace" && this.polygon) {
      this.drawing.points.pop();
      if (!this.drawing.points.length) this.drop();
    } else return false;
    this.app.view.draw();
    return true;
  }

  paint(context, view) {
    const { label, radius, tool } = this.mode;
    if (this.drawing) {
      const points = this.polygon && this.pointer ? [...this.drawing.points, this.pointer] : this.drawing.points;
      drawMark(context, view, { ...this.drawing, points, label, radius }, true, true);
    } else if (this.pointer && (tool === "click" || tool === "scribble")) {
      drawMark(context, view, { kind: "click", points: [this.pointer], label, radius }, false, true);
    }
  }
}
