// The cells of the coverage as a picture on the map, below vehicles and legs.

import { tileRequest } from "/static/core/api.js";
import { state, subscribe } from "/static/core/store.js";
import { FIRST_OVERLAY, isReady, map } from "/static/map/map.js";

const ID = "coverage";
let wanted = true;
let version = 0;

function draw() {
  const coverage = state.coverage;
  if (!isReady() || !coverage?.corners || coverage.version === version) return;
  version = coverage.version;
  const picture = { url: tileRequest(`/api/coverage/cells.png?version=${version}`).url, coordinates: coverage.corners };
  if (map.getSource(ID)) { map.getSource(ID).updateImage(picture); return; }
  map.addSource(ID, { type: "image", ...picture });
  map.addLayer({ id: ID, type: "raster", source: ID, paint: { "raster-fade-duration": 0, "raster-resampling": "nearest" }, layout: { visibility: wanted ? "visible" : "none" } }, FIRST_OVERLAY);
}

export function showCoverage(on) {
  wanted = on;
  if (map.getLayer(ID)) map.setLayoutProperty(ID, "visibility", on ? "visible" : "none");
}

subscribe("coverage ready", "the coverage on the map", draw);
