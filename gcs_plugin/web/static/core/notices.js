// Short words about what was done or went wrong, other than commands to vehicles; bad ones stay until dismissed.

import { button, make } from "/static/core/dom.js";
import { t } from "/static/core/strings.js";

const GOES_MS = 8000;
const MOST = 4;
const box = make("div", { class: "notices", role: "status" });
export const noticeBox = () => box;

// action: [label, work] of a button beside the words.
export function notice(level, text, action) {
  for (const old of box.children) if (!action && old.dataset.text === text) old.remove();
  const line = make("div", { class: "notice", dataset: { level, text, action: action ? "true" : "" } }, make("span", {}, text), action && button(action[0], () => { line.remove(); action[1](); }, { class: "small" }), button("×", () => line.remove(), { "aria-label": t("notice.dismiss") }));
  box.append(line);
  while (box.children.length > MOST) ([...box.children].slice(0, -1).find((old) => !old.dataset.action) ?? box.firstChild).remove();
  if (level === "done") setTimeout(() => line.remove(), GOES_MS);
  return line;
}
