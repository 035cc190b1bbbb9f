// What is wrong with the daemon (its /healthz) or with a part of this page, as long as it is so.

import { make, keyedList, setHidden, setText } from "/static/core/dom.js";
import { onFault } from "/static/core/guard.js";
import { changed, state, subscribe } from "/static/core/store.js";
import { t } from "/static/core/strings.js";

const faults = new Map();
onFault((name, text) => { text == null ? faults.delete(name) : faults.set(name, text); changed("problems"); });

export function problemList() {
  const list = make("ul", {});
  const summary = make("summary", {});
  const box = make("details", { class: "problems", hidden: true }, summary, list);
  const draw = keyedList(list, () => make("li", {}), (row, text) => setText(row, text));
  subscribe("problems", "problems", () => {
    const texts = [...state.problems, ...[...faults.values()].map((text) => t("problems.page", { text }))];
    draw(texts.map((text) => [text, text]));
    setText(summary, t("problems.count", { n: texts.length }));
    setHidden(box, texts.length === 0);
  });
  return box;
}
