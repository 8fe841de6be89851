// Colors and drawing of annotations.

export const COLORS = {
  object: "rgb(0 200 160)", hand: "rgb(255 140 0)", ignore: "rgb(200 120 255)", person: "rgb(150 160 255)",
};

const tinted = (color, opacity) => color.replace(")", ` / ${opacity})`);

export function drawMark(context, view, mark, chosen = false, open = false) {
  const points = mark.points.map((point) => view.toCanvas(point));
  const color = COLORS[mark.label];
  const width = 2 * mark.radius * view.scale;
  context.lineJoin = context.lineCap = "round";
  context.setLineDash(open && mark.kind === "polygon" ? [6, 4] : []);
  if (mark.kind === "scribble" && points.length > 1) {
    context.beginPath();
    points.forEach(([x, y], k) => (k ? context.lineTo(x, y) : context.moveTo(x, y)));
    stroke(context, tinted(color, chosen ? 0.6 : 0.4), width);
    stroke(context, color, chosen ? 2.5 : 1.5);
  } else if (mark.kind === "click" || mark.kind === "scribble") {
    const [x, y] = points[0];
    context.beginPath();
    context.arc(x, y, Math.max(width / 2, 2), 0, 2 * Math.PI);
    context.fillStyle = tinted(color, open ? 0.15 : 0.4);
    context.fill();
    stroke(context, color, chosen ? 3 : 1.5);
  } else {
    context.beginPath();
    if (mark.kind === "box") {
      const [[x0, y0], [x1, y1]] = points;
      context.rect(Math.min(x0, x1), Math.min(y0, y1), Math.abs(x1 - x0), Math.abs(y1 - y0));
    } else {
      points.forEach(([x, y], k) => (k ? context.lineTo(x, y) : context.moveTo(x, y)));
      if (!open) context.closePath();
    }
    stroke(context, "rgb(0 0 0 / .55)", chosen ? 5 : 3.5);
    stroke(context, color, chosen ? 3 : 1.8);
    if (mark.kind === "polygon") {
      context.setLineDash([]);
      for (const [x, y] of points) {
        context.beginPath();
        context.arc(x, y, 3, 0, 2 * Math.PI);
        context.fillStyle = color;
        context.fill();
      }
    }
  }
  context.setLineDash([]);
}

function stroke(context, color, width) {
  context.strokeStyle = color;
  context.lineWidth = width;
  context.stroke();
}
