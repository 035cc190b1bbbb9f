// Where the map is not to be trusted: the classes of confidence.tif over the imagery, as of the last export.

import { get, tileRequest } from "/static/core/api.js";
import { make, setHidden, setText } from "/static/core/dom.js";
import { changed, state, subscribe } from "/static/core/store.js";
import { t } from "/static/core/strings.js";
import { addInOrder, isReady, map } from "/static/map/map.js";
import { shownSwitch } from "/static/map/shown.js";

const ID = "trust";
const CLASSES = ["0.2", "0.5", "2", "rough"];
let shown = 0;
let asked = 0; // the export after which it was asked for

export function trustPanel() {
  const headline = make("p", {});
  const legend = make("ul", { class: "shares" }, ...CLASSES.map((key) => make("li", {}, make("i", { class: "swatch", "aria-hidden": "true", dataset: { trust: key } }), make("span", {}, t(`trust.${key}`)))));
  const toggle = shownSwitch(ID, t("legs.show"));
  subscribe("trust", "where not to trust", () => {
    const known = state.trust?.version > 0;
    for (const part of [legend, toggle]) setHidden(part, !known);
    setText(headline, known ? state.trust.headline : t("trust.none"));
  });
  return make("section", {}, make("h2", {}, t("trust.title")), headline, toggle, legend);
}

subscribe("trust ready", "where not to trust, on the map", () => {
  if (!isReady() || !state.trust?.corners || state.trust.version === shown) return;
  shown = state.trust.version;
  const picture = { url: tileRequest(`/api/trust.png?version=${shown}`).url, coordinates: state.trust.corners };
  if (map.getSource(ID)) { map.getSource(ID).updateImage(picture); return; }
  map.addSource(ID, { type: "image", ...picture });
  addInOrder({ id: ID, type: "raster", source: ID, paint: { "raster-fade-duration": 0, "raster-resampling": "nearest" }, layout: { visibility: "none" } }); // until it is known whether it is wanted
});

// An export writes it.
subscribe("jobs ready", "news of it", async () => {
  const newest = Math.max(0, ...[...state.jobs.values()].filter((job) => job.kind === "export" && job.state === "done").map((job) => job.id));
  if (newest === asked) return;
  asked = newest;
  try { state.trust = await get("/api/trust"); } catch { state.trust = null; }
  changed("trust");
});

