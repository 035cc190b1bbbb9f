// Exports by what they are for.

import { post, withToken } from "/static/core/api.js";
import { keyedList, make, setAttribute, setText } from "/static/core/dom.js";
import { notice } from "/static/core/notices.js";
import { state, subscribe } from "/static/core/store.js";
import { t } from "/static/core/strings.js";

const FORMATS = ["pack", "cog", "gpkg", "mbtiles", "kmz", "odm", "pdf", "tak", "places", "pmtiles", "stac"];
const CHOSEN = new Set(["pack"]);

export function exportPanel() {
  const boxes = FORMATS.map((key) => make("input", { type: "checkbox", name: key, checked: CHOSEN.has(key) }));
  const files = make("ul", { class: "files" });
  const send = async (event) => {
    event.preventDefault();
    const formats = FORMATS.filter((_, k) => boxes[k].checked);
    if (!formats.length) { notice("warn", t("export.choose")); return; }
    try {
      await post("/api/export", { formats });
      notice("done", t("export.begun"));
    } catch (error) {
      notice("bad", t("export.refused", { why: error.message }));
    }
  };
  const draw = keyedList(files, () => make("li", {}, make("a", { download: "" })), (row, [job, kind, name]) => {
    setAttribute(row.firstChild, "href", withToken(`/api/export/${job.id}/${encodeURIComponent(kind)}`));
    setText(row.firstChild, `${FORMATS.includes(kind) ? t(`export.${kind}`) : kind}: ${name}`);
  });
  subscribe("jobs", "exports", () => {
    const made = [...state.jobs.values()].filter((job) => job.detail?.files).sort((a, b) => a.id - b.id).pop();
    draw(made ? Object.entries(made.detail.files).map(([kind, name]) => [kind, [made, kind, name]]) : []);
  });
  return make("section", {}, make("h2", {}, t("export.title")),
    make("form", { onsubmit: send }, ...FORMATS.map((key, k) => make("label", { class: "check" }, boxes[k], make("span", {}, t(`export.${key}`)))), make("button", { type: "submit" }, t("export.go"))), files);
}
