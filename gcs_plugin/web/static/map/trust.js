// Where the map is not to be trusted: the classes of confidence.tif over the imagery, as of the last export.

import { tileRequest } from "/static/core/api.js";
import { make, setHidden, setText } from "/static/core/dom.js";
import { state, subscribe } from "/static/core/store.js";
import { t } from "/static/core/strings.js";
import { isReady } from "/static/map/map.js";
import { readAfter, showPicture } from "/static/map/picture_layer.js";
import { shownSwitch } from "/static/map/shown.js";

const ID = "trust";
const CLASSES = ["0.2", "0.5", "2", "rough"];
let shown = 0;

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
  showPicture(ID, picture);
});

readAfter("export", "trust");
