// Exports by what they are for.

import { post, withToken } from "/static/core/api.js";
import { timeOfDay } from "/static/core/clock.js";
import { keyedList, make, setAttribute, setText } from "/static/core/dom.js";
import { notice } from "/static/core/notices.js";
import { state, subscribe } from "/static/core/store.js";
import { t } from "/static/core/strings.js";

const FORMATS = ["pack", "cog", "gpkg", "mbtiles", "kmz", "odm", "pdf", "tak", "places", "pmtiles", "stac"];
const CHOSEN = new Set(["pack"]);
const REDRAW_MS = 60_000; // after midnight, what was made today is from yesterday
const CHANGES = new Set(["refine", "together", "tones", "coarse", "redraw"]); // jobs that change the map

// The newest file of each kind: the daemon exports some by itself, and what a person asked for stays beside them.
function newestFiles(jobs) {
  const changedAt = Math.max(...jobs.filter((job) => CHANGES.has(job.kind) && job.state === "done").map((job) => Date.parse(job.ended) || 0), 0);
  const newest = new Map();
  for (const job of jobs.filter((row) => row.detail?.files).sort((a, b) => a.id - b.id)) {
    const older = Date.parse(job.started) < changedAt;
    for (const [kind, name] of Object.entries(job.detail.files)) newest.set(kind, { job, kind, name, older });
  }
  return [...newest];
}

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
  const draw = keyedList(files, () => make("li", {}, make("a", { download: "" })), (row, { job, kind, name, older }) => {
    setAttribute(row.firstChild, "href", withToken(`/api/export/${job.id}/${encodeURIComponent(kind)}`));
    const text = `${FORMATS.includes(kind) ? t(`export.${kind}`) : kind}: ${name}`;
    setText(row.firstChild, [text, timeOfDay(Date.parse(job.ended)), older ? t("export.older") : ""].filter(Boolean).join(", "));
  });
  const redraw = () => draw(newestFiles([...state.jobs.values()]));
  subscribe("jobs", "exports", redraw);
  setInterval(redraw, REDRAW_MS);
  return make("section", {}, make("h2", {}, t("export.title")),
    make("form", { onsubmit: send }, ...FORMATS.map((key, k) => make("label", { class: "check" }, boxes[k], make("span", {}, t(`export.${key}`)))), make("button", { type: "submit" }, t("export.go"))), files);
}
