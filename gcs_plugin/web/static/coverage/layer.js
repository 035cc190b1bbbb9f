// The cells of the coverage as a picture on the map.

import { tileRequest } from "/static/core/api.js";
import { state, subscribe } from "/static/core/store.js";
import { addInOrder, isReady, map } from "/static/map/map.js";

const ID = "coverage";
let version = 0;

subscribe("coverage ready", "the coverage on the map", () => {
  const coverage = state.coverage;
  if (!isReady() || !coverage?.corners || coverage.version === version) return;
  version = coverage.version;
  const picture = { url: tileRequest(`/api/coverage/cells.png?version=${version}`).url, coordinates: coverage.corners };
  if (map.getSource(ID)) { map.getSource(ID).updateImage(picture); return; }
  map.addSource(ID, { type: "image", ...picture });
  addInOrder({ id: ID, type: "raster", source: ID, paint: { "raster-fade-duration": 0, "raster-resampling": "nearest" }, layout: { visibility: "none" } }); // until it is known whether it is wanted
});
