// The fields of a plan: numbers with their limits and units, choices, and what only a station with a height model can do.

import { choice, labelled, make, numberField, setHidden, setText } from "/static/core/dom.js";
import { settings } from "/static/core/settings.js";
import { t } from "/static/core/strings.js";
import * as units from "/static/core/units.js";

// key: [smallest, largest, start value, is a length]; those without a start value may stay empty
const NUMBERS = {
  vehicles: [1, 250, 3, false], altitude_m: [5, 1000, 80, true], fov_min_deg: [10, 150, 70, false],
  speed_m_s: [1, 40, "", false], endurance_min: [1, 600, "", false], side_overlap: [0, 90, "", false], forward_overlap: [0, 95, "", false],
  wind_m_s: [0, 40, "", false], wind_from_deg: [0, 360, "", false], wait_min: [0, 120, "", false], height_tolerance_m: [1, 500, "", true],
};
const SHARES = new Set(["side_overlap", "forward_overlap"]);
const CHOICES = { end: ["rtl", "land", "hover"], relief: ["auto", "follow", "level"] };
const LENSES = [["", ""], ["84", "wide"], ["70", "usual"], ["46", "narrow"], ["25", "tele"]];
const inputs = {};
const shows = make("p", { class: "quiet" });
const PIXELS = 4000; // of most drone cameras' width, to the nearest thousand

// What a picture shows of level ground with these values.
export function showFootprint() {
  const [metres, fov] = [units.toMetres(units.numberOf(inputs.altitude_m.value)), units.numberOf(inputs.fov_min_deg.value)];
  const width = 2 * metres * Math.tan((fov * Math.PI) / 360);
  setText(shows, width > 0 && fov < 170 ? t("plan.shows", { width: units.distance(width), gsd: units.fixed((100 * width) / PIXELS, 1) }) : "");
}

let terrain = null; // the section that needs a height model
let noTerrain = null;
let hasDem = false;
let changed = () => {};
let typedIn = null; // the field in which somebody is typing: values of another page do not come between the digits

// Without a height model heights count from where the vehicles take off, whatever the ground does.
const nameOf = (key) => t(key === "altitude_m" && !hasDem ? "plan.altitude_m.takeoff" : `plan.${key}`, { unit: units.lengthUnit() });

const number = (key) => {
  const [, , value] = NUMBERS[key];
  const input = numberField({ name: key, value, oninput: () => { typedIn = input; }, onblur: () => { typedIn = null; }, onchange: () => { typedIn = null; changed(); }, placeholder: value === "" ? t(`plan.${key}.none`) : undefined });
  inputs[key] = input;
  return labelled(nameOf(key), inputs[key]);
};

const chosen = (key) => {
  inputs[key] = choice(CHOICES[key].map((value) => [value, t(`plan.${key}.${value}`)]), CHOICES[key][0], () => changed());
  inputs[key].name = key;
  return labelled(t(`plan.${key}`), inputs[key]);
};

const group = (key, ...parts) => make("details", {}, make("summary", {}, t(`plan.group.${key}`)), ...parts);

// The parts of the form; onChange is called when a value was changed by hand.
export function planFields(onChange) {
  changed = onChange;
  const vehicles = number("vehicles"), altitude = number("altitude_m"), fov = number("fov_min_deg");
  const lens = choice(LENSES.map(([value, key]) => [value, t(`plan.lens.${key || "none"}`)]), "", (value) => { if (value) { inputs.fov_min_deg.value = value; showFootprint(); changed(); } });
  inputs.terrain_items = make("input", { type: "checkbox", name: "terrain_items", onchange: () => changed() });
  terrain = make("div", { hidden: true }, chosen("relief"), number("height_tolerance_m"), make("label", { class: "check" }, inputs.terrain_items, make("span", {}, t("plan.terrain_items"))), make("p", { class: "quiet" }, t("plan.terrain.about")));
  noTerrain = make("p", { class: "quiet" }, t("plan.terrain.none"));
  return [vehicles, altitude, fov, labelled(t("plan.lens"), lens), shows, chosen("end"),
    group("flight", number("speed_m_s"), number("endurance_min"), number("wait_min"), make("p", { class: "quiet" }, t("plan.wait.about"))),
    group("wind", number("wind_m_s"), number("wind_from_deg"), make("p", { class: "quiet" }, t("plan.wind.about"))),
    group("terrain", noTerrain, terrain),
    group("overlap", number("side_overlap"), number("forward_overlap"))];
}

export const followsTerrain = () => hasDem;

// Whether the station has a height model that legs can follow: its name, or null.
export function setDem(name) {
  hasDem = Boolean(name);
  setHidden(terrain, !hasDem);
  setHidden(noTerrain, hasDem);
  setText(inputs.altitude_m.closest("label").firstChild, nameOf("altitude_m"));
}

// The request's values in SI, or an error with the sentence that says what to change.
export function planValues() {
  const body = { end: inputs.end.value };
  for (const [key, [low, high, start, length]] of Object.entries(NUMBERS)) {
    if (key === "height_tolerance_m" && !hasDem) continue;
    const text = inputs[key].value.trim();
    if (text === "" && start === "") continue;
    const value = length ? units.toMetres(units.numberOf(text)) : units.numberOf(text);
    if (!(value >= low && value <= high)) {
      const show = (limit) => (length ? Math.round(units.fromMetres(limit)) : limit);
      throw new Error(t("plan.range", { name: nameOf(key), low: show(low), high: show(high) }));
    }
    body[key] = SHARES.has(key) ? value / 100 : value;
  }
  body.vehicles = Math.round(body.vehicles);
  if (body.wind_m_s > 0 && body.wind_from_deg == null) throw new Error(t("plan.wind.from"));
  if (body.wind_from_deg != null && body.wind_m_s == null) throw new Error(t("plan.wind.speed"));
  if (body.wait_min > 0 && body.end === "hover") throw new Error(t("plan.wait.hover"));
  if (hasDem) Object.assign(body, { relief: inputs.relief.value, terrain_items: inputs.terrain_items.checked });
  return body;
}

// An answer of the planner names options of the command line; here they are the names of the fields.
const FLAGS = { "--altitude": "altitude_m", "--endurance": "endurance_min", "--fov-min": "fov_min_deg", "--speed": "speed_m_s", "--vehicles": "vehicles", "--wait": "wait_min",
  "--side-overlap": "side_overlap", "--forward-overlap": "forward_overlap", "--height-tolerance": "height_tolerance_m", "--wind-m-s": "wind_m_s", "--relief": "relief" };
export const inFieldNames = (text) => text.replace(/--[a-z]+(-[a-z]+)*/g, (flag) => (FLAGS[flag] ? `"${nameOf(FLAGS[flag])}"` : flag));

// What the fields hold, lengths in metres: so that a page with other units shows the same.
function raw(key, input) {
  if (input.type === "checkbox") return input.checked;
  const value = NUMBERS[key] ? units.numberOf(input.value) : NaN;
  return Number.isFinite(value) ? (NUMBERS[key][3] ? units.toMetres(value) : String(value)) : input.value;
}
export const rawValues = () => Object.fromEntries(Object.entries(inputs).map(([key, input]) => [key, raw(key, input)]));

// Metres as a field shows them.
const inTenths = (metres) => units.typed(Number(units.fromMetres(metres).toFixed(1)));

// The fields that hold something else than `before` (as of rawValues), each with what it held then. The same metres in
// other units are the same: a field shows tenths.
export function differences(before) {
  const same = (key, value) => (NUMBERS[key]?.[3] && Number.isFinite(value) ? value.toFixed(1) : String(value));
  const shown = (key, value) => {
    if (value === "") return t("plan.empty");
    if (CHOICES[key]) return t(`plan.${key}.${value}`);
    if (typeof value === "boolean") return t(value ? "plan.on" : "plan.off");
    return NUMBERS[key]?.[3] && Number.isFinite(value) ? inTenths(value) : units.typed(value);
  };
  return Object.entries(rawValues()).filter(([key, value]) => before[key] !== undefined && same(key, value) !== same(key, before[key]))
    .map(([key]) => t("plan.was", { name: nameOf(key), value: shown(key, before[key]) }));
}

export function fillFields(values) {
  for (const [key, value] of Object.entries(values)) {
    const input = inputs[key];
    if (!input || input === typedIn) continue;
    if (input.type === "checkbox") input.checked = value === true;
    else if (CHOICES[key]) { if (CHOICES[key].includes(value)) input.value = value; }
    else input.value = NUMBERS[key][3] && Number.isFinite(value) ? inTenths(value) : units.typed(value ?? "");
  }
}

// Lengths in the fields change with the units: the same metres in other numbers.
export function relabelFields() {
  for (const [key, [, , , length]] of Object.entries(NUMBERS)) {
    if (!length) continue;
    const input = inputs[key];
    const shown = units.numberOf(input.value);
    if (Number.isFinite(shown)) {
      const metres = settings.units === "us" ? shown : shown * 0.3048;
      input.value = inTenths(metres);
    }
    setText(input.closest("label").firstChild, nameOf(key));
  }
}
