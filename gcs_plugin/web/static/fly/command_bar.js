// Pause, return and land all: on the screen in every mode, never disabled, never covered.

import { button, make } from "/static/core/dom.js";
import { state } from "/static/core/store.js";
import { t } from "/static/core/strings.js";
import { command, commandAll } from "/static/fly/commands.js";
import { commandLog } from "/static/fly/command_log.js";
import { holdConfirm } from "/static/fly/hold.js";

const TONES = { pause: "pause", resume: "go", rtl: "return", land: "land", start: "go" };
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
  const n = [...state.vehicles.values()].filter((row) => row.linked).length;
  const question = n ? t(`confirm.all.${verb}`, { n }) : t("confirm.none");
  confirm.ask(question, t(`confirm.yes.${verb}`), TONES[verb], () => commandAll(verb));
}

export function askOne(row, verb) {
  confirm.ask(t(`confirm.one.${verb}`, { name: row.name }), t(`confirm.yes.${verb}`), TONES[verb], () => command(row.id, verb));
}
