// Whether the plan was made of the area that is drawn now, and with the settings that the form has now.

import { t } from "/static/core/strings.js";
import { polygon } from "/static/plan/area.js";
import { differences, rawValues } from "/static/plan/fields.js";

const DIGITS = 7; // of a degree: a centimetre
// What the plan was made of; null: not known, for example a flight over gaps.
let madeOf = null;
let madeWith = null;

// A short text that differs for other areas (FNV-1a); it is kept with the shared plan, so that a second page knows.
export function drawnNow() {
  let hash = 0x811c9dc5;
  for (const letter of JSON.stringify(polygon().coordinates.map((ring) => ring.map((point) => point.map((value) => value.toFixed(DIGITS)))))) hash = Math.imul(hash ^ letter.charCodeAt(0), 0x01000193) >>> 0;
  return hash.toString(16);
}

export const nowMade = () => ({ made_of: drawnNow(), made_with: rawValues() });
export const madeNow = () => ({ made_of: madeOf, made_with: madeWith });
export function setMade(values) {
  madeOf = typeof values?.made_of === "string" ? values.made_of : null;
  madeWith = values?.made_with && typeof values.made_with === "object" ? values.made_with : null;
}

export const drawnSince = () => madeOf != null && madeOf !== drawnNow();

// Why the plan is not what area and form say; empty if it is.
export function outdated() {
  if (drawnSince()) return t("plan.outdated");
  const other = madeWith == null ? [] : differences(madeWith);
  return other.length ? t("plan.reset", { list: other.join("; ") }) : "";
}
