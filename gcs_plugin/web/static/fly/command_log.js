// How commands ended, a line a vehicle: what failed stays until it is dismissed, what was done goes by itself.

import { button, keyedList, make, setAttribute, setHidden, setText } from "/static/core/dom.js";
import { changed, state, subscribe } from "/static/core/store.js";
import { t } from "/static/core/strings.js";
import { inUnits } from "/static/core/units.js";
import { forget } from "/static/fly/commands.js";

const DONE_S = 12;
const ROWS = 8;

export function commandLog() {
  const title = make("h2", {});
  const clear = button(t("command.dismiss"), () => forget(), { class: "small" });
  const list = make("ul", { class: "outcomes" });
  const box = make("section", { class: "command-log", "aria-label": t("command.log"), "aria-live": "assertive", hidden: true },
    make("div", { class: "row" }, title, clear), list);
  const draw = keyedList(list, () => make("li", {}, make("b", {}), make("span", { class: "outcome" }), make("span", { class: "reason" })), (row, entry) => {
    const [name, outcome, reason] = row.children;
    setText(name, `${entry.name}: ${t(`verb.${entry.verb}`)}${entry.elsewhere ? ` (${t("command.elsewhere")})` : ""}`);
    setText(outcome, t(`outcome.${entry.outcome}`));
    setText(reason, entry.outcome === "waiting" ? "" : inUnits(entry.reason));
    setAttribute(row, "data-outcome", entry.outcome);
  });
  const RANK = { unknown: 0, not_sent: 1, refused: 2, waiting: 3, done: 4 };
  subscribe("commands tick", "outcomes of commands", () => {
    const now = performance.now();
    const kept = state.commands.filter((entry) => entry.outcome !== "done" || now - entry.ended < DONE_S * 1000);
    if (kept.length !== state.commands.length) state.commands = kept;
    const rows = [...kept].sort((a, b) => RANK[a.outcome] - RANK[b.outcome] || b.at - a.at);
    draw(rows.slice(0, Math.max(ROWS, rows.length > 100 ? 120 : 100)).map((entry) => [entry.key, entry]));
    const of = (outcome) => rows.filter((entry) => entry.outcome === outcome).length;
    setText(title, t("command.count", { done: of("done"), wait: of("waiting"), no: of("refused") + of("not_sent"), unknown: of("unknown") }));
    setHidden(box, rows.length === 0);
  });
  return box;
}

setInterval(() => changed("tick"), 1000);
