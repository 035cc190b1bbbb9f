// Areas from files (GeoJSON, KML, KMZ, zipped shapefile, GeoPackage, QGroundControl .plan). The daemon reads them, with the
// reader of the command line. Gives rings without the closing point: the outline first, then no-fly zones; a survey's
// settings as the plan's fields hold them; and in words what of the file is not used.

import { request } from "/static/core/api.js";
import { ring } from "/static/core/values.js";
import { t } from "/static/core/strings.js";

const MOST_BYTES = 20_000_000;
export const KINDS = ".geojson,.json,.kml,.kmz,.zip,.gpkg,.plan,.waypoints";

export async function readArea(file) {
  const { name } = file;
  if (file.size > MOST_BYTES) throw new Error(t("import.large", { name }));
  const { polygons, no_fly: zones, unused, settings = {} } = await request("POST", `/api/areas?name=${encodeURIComponent(name)}`, file);
  if (polygons.length === 0) throw new Error(t("import.empty", { name }));
  if (polygons.length > 1) throw new Error(t("import.many", { name, n: polygons.length }));
  const shown = (key, value) => (key === "fov_min_deg" ? String(Math.floor(10 * value) / 10) : key.endsWith("_overlap") ? String(Math.round(100 * value)) : value);
  const fields = Object.fromEntries(Object.entries(settings).map(([key, value]) => [key, shown(key, value)]));
  return { rings: [...polygons[0], ...zones].map((points) => ring(points).slice(0, -1)), unused: unused ?? [], fields };
}

// Files dropped anywhere on the page.
export function acceptDrops(target, read) {
  target.addEventListener("dragover", (event) => { if (event.dataTransfer?.types.includes("Files")) { event.preventDefault(); target.dataset.drop = "true"; } });
  target.addEventListener("dragleave", () => { delete target.dataset.drop; });
  target.addEventListener("drop", (event) => {
    delete target.dataset.drop;
    if (!event.dataTransfer?.files.length) return;
    event.preventDefault();
    read(event.dataTransfer.files[0]);
  });
}
