// The plan that was made: its figures, which vehicle flies what, upload, and the way to the preflight check.

import { get, withToken } from "/static/core/api.js";
import { button, choice, keyedList, labelled, make, setHidden, setText } from "/static/core/dom.js";
import { notice } from "/static/core/notices.js";
import { onSettings, settings } from "/static/core/settings.js";
import { state, subscribe } from "/static/core/store.js";
import { t } from "/static/core/strings.js";
import * as units from "/static/core/units.js";
import { command } from "/static/fly/commands.js";
import { onLink } from "/static/fly/need.js";
import { openPreflight } from "/static/fly/preflight.js";
import { colourOf } from "/static/map/colours.js";
import { show } from "/static/map/map.js";
import { onArea, zones } from "/static/plan/area.js";
import { outdated } from "/static/plan/outdated.js";
import { inRoutes, routeName } from "/static/plan/route_names.js";

let plan = null;
let names = {};
let changedNames = () => {};
let picture = [];
const nameOf = (id) => state.vehicles.get(id)?.name ?? id;
const heard = () => [...state.vehicles.values()].filter(onLink);

const box = make("section", { class: "plan-result", hidden: true });
const summary = make("p", {});
const warnings = make("ul", { class: "warnings" });
const list = make("ul", { class: "assignments" });
const wrong = make("p", { class: "wrong", role: "status" });
// On the map, too: the form is longer than the panel, and what is drawn there is what counts.
const older = make("p", { class: "map-note", role: "status", hidden: true });
export const olderNote = () => older;
onSettings((name) => { if (name === "mode") redraw(); });

export function planResult() {
  const upload = button(t("plan.upload"), uploadAll);
  const start = button(t("plan.start"), () => assigned() && openPreflight(plan, names, problemSince(plan, names)), { class: "primary" });
  box.append(make("h2", {}, t("plan.result")), summary, warnings, list, unfenced, wrong, make("div", { class: "row wrap" }, upload, fences, start), drones());
  return box;
}

// The plan's flights for a drone that its maker's app flies.
const DRONES = { m300: "M300, H20", "m300-p1": "M300, P1", m350: "M350, H20", "m350-p1": "M350, P1", m30: "M30", m30t: "M30T", m3e: "Mavic 3E", m3t: "Mavic 3T", m4e: "M4E", m4t: "M4T", litchi: "Litchi" };
function drones() {
  const drone = choice(Object.entries(DRONES), "m300", () => {});
  const link = make("a", { download: "", hidden: true });
  const load = button(t("plan.drone.load"), () => { link.href = withToken(`/api/plans/${plan.id}/files/${drone.value}`); link.click(); });
  return make("div", {}, labelled(t("plan.drone"), drone), load, link);
}

const draw = keyedList(list, (row) => make("li", {}, make("i", { class: "swatch", "aria-hidden": "true" }), make("b", {}), make("span", {}), make("span", { class: "pick" })), (item, row) => {
  item.firstChild.style.background = colourOf(names[row.id] || row.id);
  setText(item.children[1], routeName(row.id));
  setText(item.children[2], t("plan.share", { length: units.distance(row.length_m), time: units.clock(row.time_s), photos: row.photos, sorties: row.sorties }));
  const ids = heard().map((vehicle) => vehicle.id);
  const key = ids.map((id) => `${id}=${nameOf(id)}`).join();
  if (item.dataset.key !== key) {
    item.dataset.key = key;
    item.lastChild.replaceChildren(choice([["", t("plan.nobody")], ...ids.map((id) => [id, nameOf(id)])], names[row.id] ?? "", (id) => pick(row.id, id), t("plan.flies", { route: routeName(row.id) })));
  }
  item.lastChild.firstChild.value = names[row.id] ?? "";
});

function pick(part, vehicle) {
  names = { ...names, [part]: vehicle };
  changedNames(names);
  redraw();
  paint();
}

let pale = false;
function paint() {
  const old = pale = Boolean(plan && outdated());
  show("plan", picture.map((feature) => ({ ...feature, properties: { ...feature.properties, old, colour: colourOf(names[feature.properties.vehicle] || feature.properties.vehicle) } })));
}

function problem() {
  const older = outdated();
  if (older) return older;
  const chosen = plan.vehicles.map((row) => names[row.id]);
  const twice = chosen.find((id, k) => id && chosen.indexOf(id) !== k);
  if (twice) return t("plan.twice", { name: nameOf(twice) });
  const missing = plan.vehicles.filter((row) => !names[row.id]);
  if (missing.length) return t("plan.missing", { parts: missing.map((row) => routeName(row.id)).join(", ") });
  return "";
}

// What is wrong with a start that was prepared with a plan and an assignment, also if another page changed them meanwhile.
const problemSince = (before, assignment) => () => problem() || (plan === before && names === assignment ? "" : t("plan.reassigned"));

function assigned() {
  const text = problem();
  if (text) notice("bad", text);
  return !text;
}

// Zones bend the routes; a vehicle that is moved by other means keeps out of them only if its geofence has them.
const fences = button("", () => fenceAll(), { hidden: true });
const unfenced = make("p", { class: "quiet", role: "status" });
const rounded = (ring) => ring.map(([lon, lat]) => `${lon.toFixed(6)} ${lat.toFixed(6)}`).sort().join();
const lacks = (row) => { const held = (row?.fence?.zones ?? []).filter((zone) => !zone.inside && zone.ring.length).map((zone) => rounded(zone.ring)); return zones().coordinates.some(([ring]) => !held.includes(rounded(ring.slice(0, -1)))); };
const withoutFence = () => plan.vehicles.map((part) => state.vehicles.get(names[part.id])).filter((row) => row && onLink(row) && lacks(row));

async function fenceAll() {
  if (assigned()) await Promise.all(withoutFence().map((row) => command(row.id, "fence", { plan: plan.id })));
}

function drawFences() {
  const rows = outdated() ? [] : withoutFence();
  setHidden(fences, !rows.length);
  setText(fences, t("plan.fence", { n: rows.length }));
  setText(unfenced, rows.length ? t("plan.unfenced", { list: rows.map((row) => row.name).join(", ") }) : "");
}

export function redraw() {
  if (!plan) return;
  drawFences();
  draw(plan.vehicles.map((row) => [row.id, row]));
  setText(wrong, problem());
  const why = outdated();
  setText(older, why);
  setHidden(older, !why || settings.mode !== "plan");
  if (Boolean(why) !== pale) paint();
}

async function uploadAll() {
  if (!assigned()) return;
  await Promise.all(plan.vehicles.map((row) => command(names[row.id], "upload", { plan: plan.id, mission: row.id })));
}

export async function showPlan(made, assignment, onNames) {
  plan = made;
  names = assignment;
  changedNames = onNames;
  const km = plan.spacing_m == null ? "" : t("plan.spacing", { m: units.distance(plan.spacing_m) });
  setText(summary, t("plan.summary", { share: units.percent(plan.covered_share, 1), time: units.clock(plan.makespan_s), photos: plan.vehicles.reduce((n, row) => n + row.photos, 0), spacing: km }));
  warnings.replaceChildren(...(plan.warnings ?? []).map((text) => make("li", {}, units.inUnits(inRoutes(text)))));
  setHidden(box, false);
  redraw();
  const { features } = await get(`/api/plans/${made.id}/map`);
  if (plan !== made) return;
  picture = (features ?? []).filter((feature) => feature.geometry?.type === "LineString");
  paint();
}

// To whoever has just made it: the form is longer than the panel.
export const lookAtPlan = () => box.scrollIntoView({ block: "nearest" });

// The station has no plan now.
export function hidePlan() {
  plan = null;
  picture = [];
  setHidden(box, true);
  setHidden(older, true);
  paint();
}

subscribe("vehicles", "who flies what", redraw);
onArea(redraw);
