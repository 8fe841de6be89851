// Doubt of the masks of a frame, 0 to 1: colors, and the list of doubtful frames.

export const HIGH = 0.5;
const LEAST = 0.25;
const MOST = 12; // frames in the list
const APART = 4; // smallest distance between frames in the list

export function doubtColor(doubt) {
  return doubt > HIGH ? "#ff6b5e" : doubt > LEAST ? "#e0b03c" : "#3d6b5f";
}

// The most doubtful frames of doubt [T], a few frames apart.
export function worst(doubt) {
  const order = doubt.map((value, frame) => ({ frame, doubt: value })).filter((one) => one.doubt >= LEAST)
    .sort((a, b) => b.doubt - a.doubt);
  const chosen = [];
  for (const one of order) {
    if (chosen.length >= MOST) break;
    if (chosen.every((other) => Math.abs(other.frame - one.frame) > APART)) chosen.push(one);
  }
  return chosen;
}
