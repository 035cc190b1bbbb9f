// Whether the plan was made of the area that is drawn now: a zone that is drawn later is not in its lines.

import { polygon } from "/static/plan/area.js";

const DIGITS = 7; // of a degree: a centimetre
let madeOf = null; // null: not known, for example a flight over gaps

// A short text that differs for other areas (FNV-1a); it is kept with the shared plan, so that a second page knows.
export function drawnNow() {
  let hash = 0x811c9dc5;
  for (const letter of JSON.stringify(polygon().coordinates.map((ring) => ring.map((point) => point.map((value) => value.toFixed(DIGITS)))))) hash = Math.imul(hash ^ letter.charCodeAt(0), 0x01000193) >>> 0;
  return hash.toString(16);
}

export const setMadeOf = (value) => { madeOf = typeof value === "string" ? value : null; };
export const madeOfNow = () => madeOf;
export const outdated = () => madeOf != null && madeOf !== drawnNow();
