// Pause, return and land all: on the screen in every mode, never disabled, never covered.

import { button, make } from "/static/core/dom.js";
import { state } from "/static/core/store.js";
import { t } from "/static/core/strings.js";
import { command, commandAll } from "/static/fly/commands.js";
import { commandLog } from "/static/fly/command_log.js";
import { holdConfirm } from "/static/fly/hold.js";
import { inAir, onLink } from "/static/fly/need.js";

const TONES = { pause: "pause", resume: "go", continue: "go", rtl: "return", land: "land", start: "go" };
const DEGREE_M = 111_320;
const NEAR_M = 15; // what a plan takes for one start
let confirm = null;

export function commandBar() {
  confirm = holdConfirm();
  const all = (verb, symbol) => make("button", { type: "button", class: "command", dataset: { tone: TONES[verb], verb }, onclick: () => askAll(verb) },
    make("span", { "aria-hidden": "true", class: "symbol" }, symbol), t(`all.${verb}`));
  const more = button(t("all.resume"), () => askAll("resume"), { class: "command", dataset: { tone: "go", verb: "resume" } });
  more.dataset.tone = "go";
  more.dataset.verb = "resume";
  return make("footer", { class: "command-bar", "aria-label": t("all.bar") }, make("div", { class: "above" }, confirm.box, commandLog()),
    make("div", { class: "commands", role: "group", "aria-label": t("all.bar") }, all("pause", "❚❚"), all("rtl", "⤺"), all("land", "⤓"), more));
}

function askAll(verb) {
  const n = [...state.vehicles.values()].filter(onLink).length;
  const question = n ? t(`confirm.all.${verb}`, { n }) : t("confirm.none");
  const aloft = [...state.vehicles.values()].filter((row) => onLink(row) && inAir(row));
  const inTurn = verb === "rtl" && aloft.length > 1;
  const meet = inTurn && neighbours(aloft) ? ` ${t("confirm.meet")}` : "";
  if (!inTurn) { confirm.ask(question, t(`confirm.yes.${verb}`), TONES[verb], () => commandAll(verb)); return; }
  // What is recommended comes first, in its colour.
  confirm.ask(question + meet, t("confirm.yes.return"), TONES.rtl, () => commandAll("return"), { label: t("confirm.yes.together"), tone: "plain", work: () => commandAll(verb) });
}

// Whether two have their homes so near each other that they may meet there, on straight ways at one height.
function neighbours(rows) {
  const homes = rows.map((row) => row.home).filter(Boolean);
  return homes.some(([lon, lat], k) => homes.slice(k + 1).some(([lon2, lat2]) =>
    Math.hypot((lat2 - lat) * DEGREE_M, (lon2 - lon) * DEGREE_M * Math.cos(lat * Math.PI / 180)) < NEAR_M));
}

export function askOne(row, verb) {
  confirm.ask(t(`confirm.one.${verb}`, { name: row.name }), t(`confirm.yes.${verb}`), TONES[verb], () => command(row.id, verb));
}
