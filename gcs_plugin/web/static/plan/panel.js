// Plan mode: the area, what is wanted, the plan, and which vehicle flies what.

import { get, post } from "/static/core/api.js";
import { button, choice, labelled, make, setHidden, setText } from "/static/core/dom.js";
import { notice } from "/static/core/notices.js";
import { onSettings, settings } from "/static/core/settings.js";
import { state } from "/static/core/store.js";
import { t } from "/static/core/strings.js";
import * as units from "/static/core/units.js";
import { ring } from "/static/core/values.js";
import * as area from "/static/plan/area.js";
import * as editor from "/static/plan/editor.js";
import { acceptDrops, KINDS, readArea } from "/static/plan/import.js";
import { planResult, showPlan } from "/static/plan/result.js";
import { isSaving, loadShared, saveShared, whenChangedElsewhere } from "/static/plan/shared.js";
import { boundsOf, fit } from "/static/map/map.js";

// key: [smallest, largest, start value, is a length]
const FIELDS = {
  vehicles: [1, 250, 3, false], altitude_m: [5, 1000, 80, true], fov_min_deg: [10, 150, 70, false],
  speed_m_s: [1, 40, "", false], endurance_min: [1, 600, "", false], side_overlap: [0, 90, "", false], forward_overlap: [0, 95, "", false],
};
const SHARES = new Set(["side_overlap", "forward_overlap"]);
const MORE = ["speed_m_s", "endurance_min", "side_overlap", "forward_overlap"];
const LENSES = [["", ""], ["84", "wide"], ["70", "usual"], ["46", "narrow"], ["25", "tele"]];
const inputs = {};
let end = null;

const field = (key) => {
  const [low, high, value, length] = FIELDS[key];
  inputs[key] = make("input", { type: "number", name: key, min: length ? undefined : low, max: length ? undefined : high, step: "any", value, inputmode: "decimal", onchange: save });
  return labelled(t(`plan.${key}`, { unit: units.lengthUnit() }), inputs[key]);
};

// The request's values in SI, or the sentence that says what to change.
function values() {
  const body = { end: end.value };
  for (const [key, [low, high, , length]] of Object.entries(FIELDS)) {
    if (inputs[key].value === "" && MORE.includes(key)) continue;
    const value = length ? units.toMetres(Number(inputs[key].value)) : Number(inputs[key].value);
    if (inputs[key].value === "" || !(value >= low && value <= high)) {
      const show = (limit) => (length ? Math.round(units.fromMetres(limit)) : limit);
      throw new Error(t("plan.range", { name: t(`plan.${key}`, { unit: units.lengthUnit() }), low: show(low), high: show(high) }));
    }
    body[key] = SHARES.has(key) ? value / 100 : value;
  }
  body.vehicles = Math.round(body.vehicles);
  return body;
}

function raw() { return { ...Object.fromEntries(Object.entries(inputs).map(([key, input]) => [key, FIELDS[key][3] && input.value !== "" ? units.toMetres(Number(input.value)) : input.value])), end: end.value }; }

let made = null;
let names = {};
function save() { saveShared({ area: area.area.rings.length ? area.polygon() : null, settings: raw(), plan: made?.id ?? null, vehicles: names }); }

export async function loadPlan() {
  if (isSaving()) return;
  const body = await loadShared();
  if (!body) return;
  const rings = (body.area?.coordinates ?? []).map((points) => ring(points).slice(0, -1)).filter((points) => points.length > 2);
  if (body.area || area.area.rings.length) area.replace(rings);
  for (const [key, value] of Object.entries(body.settings ?? {})) {
    if (key === "end" && value) end.value = value;
    else if (inputs[key]) inputs[key].value = FIELDS[key][3] && value !== "" ? Number(units.fromMetres(Number(value)).toFixed(1)) : value;
  }
  names = body.vehicles ?? {};
  if (body.plan && body.plan !== made?.id) {
    const plan = (await get("/api/plans")).find((row) => row.id === body.plan);
    if (plan) { made = plan; await showPlan(plan, names, onNames); }
  }
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
  end = choice(["rtl", "land", "hover"].map((key) => [key, t(`plan.end.${key}`)]), "rtl", save);
  const lens = choice(LENSES.map(([value, key]) => [value, t(`plan.lens.${key || "none"}`)]), "", (value) => { if (value) { inputs.fov_min_deg.value = value; save(); } });
  const form = make("form", { novalidate: true, onsubmit: submit }, field("vehicles"), field("altitude_m"), field("fov_min_deg"), labelled(t("plan.lens"), lens), labelled(t("plan.end"), end),
    make("details", {}, make("summary", {}, t("plan.more")), ...MORE.map(field)), go);
  async function read(dropped) {
    try {
      const rings = await readArea(dropped);
      area.change((old) => old.splice(0, old.length, ...rings));
      fit(boundsOf(rings[0]));
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
    setText(go, t("plan.making"));
    try {
      const body = { ...values(), area: area.outline(), no_fly: area.zones() };
      const heard = [...state.vehicles.values()].filter((row) => row.linked && row.position);
      if (heard.length >= body.vehicles) body.starts = heard.slice(0, body.vehicles).map((row) => [row.position[1], row.position[0]]);
      made = await post("/api/plans", body);
      names = Object.fromEntries(made.vehicles.map((row, k) => [row.id, heard.length >= made.vehicles.length ? heard[k].id : ""]));
      await showPlan(made, names, onNames);
      save();
    } catch (error) {
      notice("bad", t("plan.failed", { why: error.message }));
    } finally {
      go.disabled = false;
      setText(go, t("plan.make"));
    }
  }
  const refresh = (why) => {
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
  onSettings((name) => { if (name === "units") { refresh("units"); relabel(form); } });
  document.addEventListener("keydown", (event) => {
    if (settings.mode !== "plan" || !(event.ctrlKey || event.metaKey) || /INPUT|TEXTAREA|SELECT/.test(event.target.tagName)) return;
    if (event.key.toLowerCase() === "z") { event.preventDefault(); event.shiftKey ? area.redo() : area.undo(); }
    else if (event.key.toLowerCase() === "y") { event.preventDefault(); area.redo(); }
  });
  acceptDrops(document.body, read);
  refresh("made");
  return make("div", {}, make("section", {}, make("h2", {}, t("area.title")), hint, make("div", { class: "row wrap" }, drawing, open, hole, undo, redo, clear), file, make("p", { class: "quiet" }, t("area.help"))),
    make("section", {}, make("h2", {}, t("plan.title")), form), planResult());
}

// Lengths in the fields change with the units: the same metres in other numbers.
function relabel(form) {
  for (const [key, [, , , length]] of Object.entries(FIELDS)) {
    if (!length) continue;
    const metres = settings.units === "us" ? Number(inputs[key].value) : Number(inputs[key].value) * 0.3048;
    inputs[key].value = Number(units.fromMetres(metres).toFixed(1));
    setText(form.querySelector(`[name=${key}]`).closest("label").firstChild, t(`plan.${key}`, { unit: units.lengthUnit() }));
  }
}
