// What the daemon works on, with progress; and the wish to refine now.

import { post } from "/static/core/api.js";
import { button, keyedList, make, setAttribute, setHidden, setStyle, setText } from "/static/core/dom.js";
import { notice } from "/static/core/notices.js";
import { state, subscribe } from "/static/core/store.js";
import { t } from "/static/core/strings.js";
import { fixed } from "/static/core/units.js";

const MOST = 12;
const nameOf = (id) => state.vehicles.get(id)?.name ?? id ?? "";

export async function refine(vehicle) {
  try {
    const jobs = await post("/api/refine", vehicle ? { vehicle } : {});
    notice("done", t("jobs.asked", { n: jobs?.length ?? 0 }));
  } catch (error) {
    notice("bad", t("jobs.refused", { why: error.message }));
  }
}

// Work in the background comes and goes by itself: only what is under way, or went wrong, is worth a line.
const worth = (job) => !["coarse", "together", "tones", "change"].includes(job.kind) || job.state === "running" || job.state === "failed";

// A refinement that found none of its lines on the basemap is done, and its pictures lie where the receiver says.
const mapped = () => state.layers.some((layer) => layer.name === "basemap");
function unmatched(job) {
  if (!["refine", "coarse"].includes(job.kind) || job.state !== "done" || !mapped()) return false;
  const legs = state.legs.filter(({ properties: leg }) => leg?.vehicle === job.vehicle && leg.sortie === job.sortie);
  return legs.length > 0 && legs.every(({ properties: leg }) => leg.state === "failed");
}

// An export waits for refinements, so that it holds their result.
const refining = () => [...state.jobs.values()].some((job) => job.kind === "refine" && ["queued", "running"].includes(job.state));

export function jobPanel() {
  const list = make("ul", { class: "jobs" });
  const nothing = make("p", { class: "quiet" }, t("jobs.none"));
  const draw = keyedList(list, () => make("li", {}, make("b", {}), make("span", {}), make("span", { class: "bar" }, make("i", {}))), (row, job) => {
    const [title, words, bar] = row.children;
    setText(title, `${t(`jobs.${job.kind}`)} ${nameOf(job.vehicle)}${job.sortie > 1 ? ` ${t("jobs.sortie", { n: job.sortie })}` : ""}`);
    const behind = job.kind === "export" && job.state === "queued" && refining();
    const lost = unmatched(job);
    setText(words, [t(behind ? "jobs.behind" : lost ? "jobs.unmatched" : `jobs.state.${job.state}`), job.message, ...(job.detail?.warnings ?? []), job.detail?.seconds ? `${fixed(job.detail.seconds, 1)} s` : ""].filter(Boolean).join(", "));
    setStyle(bar.firstChild, "transform", `scaleX(${Math.max(0, Math.min(1, job.progress || 0))})`);
    setAttribute(row, "data-state", lost ? "unmatched" : job.state);
  });
  subscribe("jobs vehicles legs", "jobs", () => {
    const rows = [...state.jobs.values()].filter(worth).sort((a, b) => b.id - a.id).slice(0, MOST);
    draw(rows.map((job) => [job.id, job]));
    setHidden(nothing, rows.length > 0);
  });
  return make("section", {}, make("h2", {}, t("jobs.title")), nothing, list, button(t("jobs.all"), () => refine()));
}
