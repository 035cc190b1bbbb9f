// Short words about what was done or went wrong, other than commands to vehicles; bad ones stay until dismissed.

import { button, make } from "/static/core/dom.js";
import { t } from "/static/core/strings.js";

const GOES_MS = 8000;
const box = make("div", { class: "notices", role: "status" });
export const noticeBox = () => box;

export function notice(level, text) {
  for (const old of box.children) if (old.dataset.text === text) old.remove();
  const line = make("div", { class: "notice", dataset: { level, text } }, make("span", {}, text), button("×", () => line.remove(), { "aria-label": t("notice.dismiss") }));
  box.append(line);
  while (box.children.length > 4) box.firstChild.remove();
  if (level === "done") setTimeout(() => line.remove(), GOES_MS);
  return line;
}
