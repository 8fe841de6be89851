// Doubt of the masks of a frame, 0 to 1: its colors, and which frames are shown first.

export const HIGH = 0.5;
const LEAST = 0.25;
const MOST = 12; // frames in the list
const APART = 4; // frames between two of the list

export function doubtColor(doubt) {
  return doubt > HIGH ? "#ff6b5e" : doubt > LEAST ? "#e0b03c" : "#3d6b5f";
}

// The worst frames of doubt [T], each a few frames from the others.
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
