// The area to be mapped: an outline, and no-fly zones inside it or beside it, each a ring of [lon, lat] without the closing point; with undo and redo.

import { areaOf, crossesItself } from "/static/map/geodesy.js";
import { t } from "/static/core/strings.js";

const MOST_STEPS = 200;
const listeners = [];
let past = [];
let future = [];
export const area = { rings: [] };

const copy = (rings) => rings.map((ring) => ring.map((point) => [...point]));
const tell = (why) => listeners.forEach((work) => work(why));
export const onArea = (work) => { listeners.push(work); };

// Change the rings: work gets a copy to change. One change is one step of undo.
export function change(work) {
  const next = copy(area.rings);
  work(next);
  past.push(area.rings);
  if (past.length > MOST_STEPS) past.shift();
  future = [];
  area.rings = next;
  tell("changed");
}

// A drag is one step however often it moves: this shows without a step.
export function preview(work) {
  const next = copy(area.rings);
  work(next);
  area.rings = next;
  tell("preview");
}

export function remember() { past.push(copy(area.rings)); future = []; }

function step(from, to) {
  if (!from.length) return;
  to.push(area.rings);
  area.rings = from.pop();
  tell("changed");
}
export const undo = () => step(past, future);
export const redo = () => step(future, past);
export const canUndo = () => past.length > 0;
export const canRedo = () => future.length > 0;

export function replace(rings) {
  if (JSON.stringify(rings) === JSON.stringify(area.rings)) return;
  area.rings = copy(rings);
  past = [];
  future = [];
  tell("loaded");
}

// The outline keeps its place however few corners it has: a no-fly zone in it would be read as the area to fly over.
const closed = () => area.rings.filter((ring, k) => !k || ring.length > 2).map((ring) => (ring.length ? [...ring, ring[0]] : []));
export const polygon = () => ({ type: "Polygon", coordinates: closed() });
export const outline = () => ({ type: "Polygon", coordinates: closed().slice(0, 1) });
export const zones = () => ({ type: "MultiPolygon", coordinates: closed().slice(1).map((ring) => [ring]) });
export const size_m2 = () => Math.max(0, areaOf(area.rings[0] ?? []) - area.rings.slice(1).reduce((sum, ring) => sum + areaOf(ring), 0));

// What is wrong with the area, as what to change; empty if it can be planned.
export function problem() {
  if (!area.rings.length || area.rings[0].length === 0) return t("area.none");
  for (const [k, ring] of area.rings.entries()) {
    const which = k ? t("area.hole", { n: k }) : t("area.outline");
    if (ring.length < 3) return t("area.few", { which, n: 3 - ring.length });
    if (crossesItself(ring)) return t("area.crosses", { which });
  }
  return "";
}
