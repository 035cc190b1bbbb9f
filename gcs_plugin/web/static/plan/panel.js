// Plan mode: the area, what is wanted, the plan, and which vehicle flies what.

import { get, post } from "/static/core/api.js";
import { button, keyedList, make, setAttribute, setHidden, setText } from "/static/core/dom.js";
import { notice } from "/static/core/notices.js";
import { onSettings, settings } from "/static/core/settings.js";
import { state } from "/static/core/store.js";
import { t } from "/static/core/strings.js";
import * as units from "/static/core/units.js";
import { ring } from "/static/core/values.js";
import { inAir, onLink } from "/static/fly/need.js";
import * as area from "/static/plan/area.js";
import * as editor from "/static/plan/editor.js";
import { fillFields, followsTerrain, inFieldNames, planFields, planValues, rawValues, relabelFields, setDem, showFootprint } from "/static/plan/fields.js";
import { acceptDrops, KINDS, readArea } from "/static/plan/import.js";
import { madeNow, nowMade, setMade } from "/static/plan/outdated.js";
import { hidePlan, lookAtPlan, planResult, redraw, showPlan } from "/static/plan/result.js";
import { keptArea, loadShared, mayLoad, saveShared, whenChangedElsewhere } from "/static/plan/shared.js";
import { boundsOf, fit } from "/static/map/map.js";

const PLANNING_MS = 600_000; // a large area for many vehicles, or the first plan of an installation, which compiles
let made = null;
let names = {};
function save() { saveShared(() => ({ area: area.area.rings.length ? area.polygon() : null, settings: { ...rawValues(), ...madeNow() }, plan: made?.id ?? null, vehicles: names })); }
const ringsOf = (polygon) => {
  const rings = (polygon?.coordinates ?? []).map((points) => ring(points).slice(0, -1)).filter((points, k) => !k || points.length > 2);
  return rings.length > 1 || rings[0]?.length ? rings : [];
};

export async function loadPlan(merged = null) {
  if (!merged && !mayLoad()) return;
  const kept = ringsOf(keptArea());
  const body = merged ?? await loadShared();
  if (!body) return;
  const rings = ringsOf(body.area);
  setMade(body.plan ? body.settings : null);
  let unsaved = false;
  if (editor.isDrawing()) unsaved = editor.mergeDrawn(rings, kept);
  else if (body.area || area.area.rings.length) area.replace(rings);
  fillFields(body.settings ?? {});
  setDem(body.dem);
  const before = names;
  names = body.vehicles ?? {};
  if (made && body.plan === made.id && JSON.stringify(before) !== JSON.stringify(names)) await showPlan(made, names, onNames);
  if ((body.plan ?? null) !== (made?.id ?? null)) {
    const plan = body.plan ? (await get("/api/plans")).find((row) => row.id === body.plan) : null;
    made = plan ?? null;
    if (plan) await showPlan(plan, names, onNames);
    else hidePlan();
  }
  redraw();
  showFootprint();
  if (unsaved) save();
}

whenChangedElsewhere(loadPlan);
const onNames = (chosen) => { names = chosen; save(); };

export function planPanel() {
  const hint = make("p", { class: "hint", role: "status" });
  const drawing = button("", () => (editor.isDrawing() ? editor.stopDrawing() : editor.draw(0)), { class: "primary" });
  const hole = button(t("area.addhole"), () => editor.draw(area.area.rings.length));
  const undo = button(t("area.undo"), area.undo);
  const redo = button(t("area.redo"), area.redo);
  const clear = button(t("area.clear"), () => { editor.stopDrawing(); area.change((rings) => rings.splice(0)); });
  const file = make("input", { type: "file", accept: KINDS, class: "hidden-file", "aria-label": t("import.label"), onchange: () => { if (file.files[0]) read(file.files[0]); file.value = ""; } });
  const open = button(t("import.open"), () => file.click());
  const go = make("button", { type: "submit", class: "primary" }, t("plan.make"));
  let turn = 0;
  let givenUp = () => {};
  const stop = button(t("plan.stop"), () => givenUp(), { hidden: true });
  const form = make("form", { novalidate: true, onsubmit: submit, oninput: () => { redraw(); showFootprint(); }, onchange: () => { redraw(); showFootprint(); } }, ...planFields(save), go, stop);
  async function read(dropped) {
    try {
      const { rings, unused, fields } = await readArea(dropped);
      const given = new Set(rings.map((points) => JSON.stringify(points)));
      const kept = area.area.rings.slice(1).filter((points) => points.length > 2 && !given.has(JSON.stringify(points)));
      editor.stopDrawing();
      fillFields(fields); // saved with the area
      area.change((old) => old.splice(0, old.length, ...rings, ...kept)); // a zone goes only if somebody deletes it
      fit(boundsOf(rings[0]));
      if (kept.length) notice("warn", t("import.kept", { n: kept.length }));
      if (unused.length) notice("warn", t("import.unused", { name: dropped.name, what: unused.join(", ") }));
      notice("done", t("import.done", { name: dropped.name, size: units.area(area.size_m2()) }));
    } catch (error) {
      notice("bad", error.message);
    }
  }
  async function submit(event) {
    event.preventDefault();
    editor.stopDrawing();
    const wrong = area.problem();
    if (wrong) { notice("bad", wrong); return; }
    go.disabled = true;
    setHidden(stop, false);
    const began = performance.now();
    const clock = setInterval(() => setText(go, t("plan.making.for", { time: units.clock((performance.now() - began) / 1000) })), 1000);
    setText(go, t("plan.making"));
    const mine = ++turn;
    try {
      const body = { ...planValues(), area: area.outline(), no_fly: area.zones() };
      const heard = [...state.vehicles.values()].filter((row) => onLink(row) && row.position);
      if (followsTerrain() && !heard.length) throw new Error(t("plan.terrain.start"));
      const flies = heard.slice(0, body.vehicles).some(inAir); // it takes off elsewhere; the daemon warns
      if ((heard.length >= body.vehicles && !flies) || followsTerrain()) body.starts = heard.slice(0, body.vehicles).map((row) => [row.position[1], row.position[0]]);
      const now = nowMade();
      const plan = await Promise.race([post("/api/plans", body, PLANNING_MS), new Promise((_, no) => { givenUp = () => no(new Error(t("plan.stopped"))); })]);
      if (mine !== turn) return;
      made = plan;
      setMade(now);
      names = Object.fromEntries(made.vehicles.map((row, k) => [row.id, heard.length >= made.vehicles.length ? heard[k].id : ""]));
      save();
      await showPlan(made, names, onNames);
      lookAtPlan();
    } catch (error) {
      notice("bad", t("plan.failed", { why: inFieldNames(error.message) }));
    } finally {
      clearInterval(clock);
      setHidden(stop, true);
      go.disabled = false;
      setText(go, t("plan.make"));
    }
  }
  const zones = make("ul", { class: "zones" });
  const drawZones = keyedList(zones, () => { const row = make("li", {}, make("span", {}), button(t("area.zone.delete"), () => { editor.stopDrawing(); area.change((rings) => rings.splice(row.ring, 1)); }, { class: "small" })); return row; }, (row, ring) => {
    row.ring = ring;
    setText(row.firstChild, t("area.hole", { n: ring }));
    setAttribute(row.lastChild, "aria-label", `${t("area.zone.delete")}: ${t("area.hole", { n: ring })}`);
  });
  const refresh = (why) => {
    drawZones(area.area.rings.slice(1).map((_, k) => [k, k + 1]));
    const wrong = area.problem();
    setText(hint, editor.isDrawing() ? t("area.drawing") : wrong || t("area.ready", { size: units.area(area.size_m2()) }));
    setText(drawing, t(editor.isDrawing() ? "area.done" : area.area.rings.length ? "area.more" : "area.draw"));
    undo.disabled = !area.canUndo();
    redo.disabled = !area.canRedo();
    hole.disabled = Boolean(wrong) && !editor.isDrawing();
    setHidden(clear, area.area.rings.length === 0);
    if (why === "changed") save();
  };
  area.onArea(refresh);
  editor.onDrawing(() => refresh("drawing"));
  onSettings((name) => { if (name === "units") { refresh("units"); relabelFields(); showFootprint(); } });
  document.addEventListener("keydown", (event) => {
    if (settings.mode !== "plan" || !(event.ctrlKey || event.metaKey) || /INPUT|TEXTAREA|SELECT/.test(event.target.tagName)) return;
    if (event.key.toLowerCase() === "z") { event.preventDefault(); event.shiftKey ? area.redo() : area.undo(); }
    else if (event.key.toLowerCase() === "y") { event.preventDefault(); area.redo(); }
  });
  acceptDrops(document.body, read);
  refresh("made");
  showFootprint();
  return make("div", {}, make("section", {}, make("h2", {}, t("area.title")), hint, make("div", { class: "row wrap" }, drawing, open, hole, undo, redo, clear), zones, file, make("p", { class: "quiet" }, t("area.files")), make("p", { class: "quiet" }, t("area.help"))),
    make("section", {}, make("h2", {}, t("plan.title")), form), planResult());
}
