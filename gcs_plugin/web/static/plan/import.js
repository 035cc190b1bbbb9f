// Areas from files: GeoJSON and KML here, other kinds by the daemon. Gives rings without the closing point.

import { request } from "/static/core/api.js";
import { position } from "/static/core/values.js";
import { t } from "/static/core/strings.js";

const MOST_BYTES = 20_000_000;

export async function readArea(file) {
  if (file.size > MOST_BYTES) throw new Error(t("import.large", { name: file.name }));
  if (/\.kml$/i.test(file.name)) return fromKml(await file.text(), file.name);
  if (/\.(geo)?json$/i.test(file.name)) return fromGeoJson(parse(await file.text(), file.name), file.name);
  const form = new FormData();
  form.append("file", file);
  try {
    return fromGeoJson(await request("POST", "/api/areas", form), file.name);
  } catch (error) {
    throw new Error(error.status === 404 || error.status === 405 ? t("import.kind", { name: file.name }) : error.message);
  }
}

function parse(text, name) {
  try {
    return JSON.parse(text);
  } catch {
    throw new Error(t("import.json", { name }));
  }
}

function polygonsOf(value, found = []) {
  if (!value || typeof value !== "object") return found;
  if (value.type === "Polygon") found.push(value.coordinates);
  else if (value.type === "MultiPolygon") found.push(...(value.coordinates ?? []));
  else if (value.type === "Feature") polygonsOf(value.geometry, found);
  else for (const part of value.features ?? value.geometries ?? []) polygonsOf(part, found);
  return found;
}

export function fromGeoJson(document, name) {
  return ringsOf(polygonsOf(document), name);
}

export function fromKml(text, name) {
  const document = new DOMParser().parseFromString(text, "application/xml");
  if (document.querySelector("parsererror")) throw new Error(t("import.xml", { name }));
  const all = (element, tag) => [...element.getElementsByTagNameNS("*", tag)];
  const points = (element) => (all(element, "coordinates")[0]?.textContent ?? "").trim().split(/\s+/).map((p) => p.split(",").map(Number));
  const polygons = all(document, "Polygon").map((p) => [...all(p, "outerBoundaryIs"), ...all(p, "innerBoundaryIs")].map(points));
  return ringsOf(polygons, name);
}

function ringsOf(polygons, name) {
  if (polygons.length === 0) throw new Error(t("import.empty", { name }));
  if (polygons.length > 1) throw new Error(t("import.many", { name, n: polygons.length }));
  return (Array.isArray(polygons[0]) ? polygons[0] : []).map((ring) => {
    const points = (Array.isArray(ring) ? ring : []).map((p) => position(Number(p?.[0]), Number(p?.[1])));
    if (points.some((p) => !p)) throw new Error(t("import.degrees", { name }));
    const [first, last] = [points[0], points.at(-1)];
    if (points.length > 1 && first[0] === last[0] && first[1] === last[1]) points.pop();
    if (points.length < 3) throw new Error(t("import.empty", { name }));
    return points;
  });
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
