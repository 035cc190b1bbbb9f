// Positions as decimal degrees, degrees minutes seconds, UTM, and MGRS/USNG, on WGS 84.
// Transverse Mercator by Krüger's series to the fourth order (Karney 2011, eq. 35): below a millimetre in a zone.

const A = 6378137.0;
const F = 1 / 298.257223563;
const N = F / (2 - F);
const RADIUS = (A / (1 + N)) * (1 + N ** 2 / 4 + N ** 4 / 64);
const ALPHA = [
  N / 2 - (2 * N ** 2) / 3 + (5 * N ** 3) / 16 + (41 * N ** 4) / 180,
  (13 * N ** 2) / 48 - (3 * N ** 3) / 5 + (557 * N ** 4) / 1440,
  (61 * N ** 3) / 240 - (103 * N ** 4) / 140,
  (49561 * N ** 4) / 161280,
];
const RAD = Math.PI / 180;
const BANDS = "CDEFGHJKLMNPQRSTUVWX";

function zoneOf(lat, lon) {
  const zone = Math.min(60, Math.floor((lon + 180) / 6) + 1);
  if (lat >= 56 && lat < 64 && lon >= 3 && lon < 12) return 32;
  if (lat >= 72 && lat < 84 && lon >= 0 && lon < 42) return lon < 9 ? 31 : lon < 21 ? 33 : lon < 33 ? 35 : 37;
  return zone;
}

// Beyond the meridian of 180 degrees the map goes on counting.
const wrapped = (lon) => (lon >= -180 && lon <= 180 ? lon : ((((lon + 180) % 360) + 360) % 360) - 180);

// UTM of a position: { zone, band, east, north } in metres; null outside 80 S to 84 N.
export function utm(lat, lon, zone = zoneOf(lat, lon)) {
  if (!(lat >= -80 && lat <= 84)) return null;
  const away = (lon - (6 * zone - 183)) * RAD;
  const e = Math.sqrt(F * (2 - F));
  const sin = Math.sin(lat * RAD);
  const t = Math.sinh(Math.atanh(sin) - e * Math.atanh(e * sin));
  const xi = Math.atan2(t, Math.cos(away));
  const eta = Math.asinh(Math.sin(away) / Math.hypot(t, Math.cos(away)));
  let [x, y] = [eta, xi];
  ALPHA.forEach((a, k) => {
    x += a * Math.cos(2 * (k + 1) * xi) * Math.sinh(2 * (k + 1) * eta);
    y += a * Math.sin(2 * (k + 1) * xi) * Math.cosh(2 * (k + 1) * eta);
  });
  const band = BANDS[Math.min(19, Math.floor((lat + 80) / 8))];
  return { zone, band, east: 500000 + 0.9996 * RADIUS * x, north: 0.9996 * RADIUS * y + (lat < 0 ? 1e7 : 0) };
}

export function mgrs(lat, lon, digits = 5) {
  const grid = utm(lat, lon);
  if (!grid) return null;
  const column = "ABCDEFGHJKLMNPQRSTUVWXYZ"[((grid.zone - 1) % 3) * 8 + Math.floor(grid.east / 1e5) - 1];
  const row = "ABCDEFGHJKLMNPQRSTUV"[(Math.floor(grid.north / 1e5) + (grid.zone % 2 ? 0 : 5)) % 20];
  const part = (value) => String(Math.floor((value % 1e5) / 10 ** (5 - digits))).padStart(digits, "0");
  return `${grid.zone}${grid.band} ${column}${row} ${part(grid.east)} ${part(grid.north)}`;
}

function dms(value, positive, negative) {
  const tenths = Math.round(Math.abs(value) * 36000);
  const [degrees, minutes, seconds] = [Math.floor(tenths / 36000), Math.floor(tenths / 600) % 60, (tenths % 600) / 10];
  return `${degrees}°${String(minutes).padStart(2, "0")}′${seconds.toFixed(1).padStart(4, "0")}″${value < 0 ? negative : positive}`;
}

// The position of UTM coordinates, by going there in steps; null where there is none.
function fromUtm(zone, south, east, north) {
  if (!(zone >= 1 && zone <= 60)) return null;
  let lat = (north - (south ? 1e7 : 0)) / 110_900;
  let lon = 6 * zone - 183;
  for (let k = 0; k < 20; k++) {
    const here = utm(lat, lon, zone);
    if (!here) return null;
    lat += (north - (here.north - (lat < 0 ? 1e7 : 0) + (south ? 1e7 : 0))) / 110_900;
    lon += (east - here.east) / (111_320 * Math.cos(lat * RAD));
  }
  return Number.isFinite(lat) && Number.isFinite(lon) ? [lon, lat] : null;
}

function fromMgrs(zone, band, column, row, digits) {
  const half = digits.length / 2;
  const step = 10 ** (5 - half);
  const [x, y] = [Number(digits.slice(0, half)) * step, Number(digits.slice(half)) * step];
  const east = ("ABCDEFGHJKLMNPQRSTUVWXYZ".indexOf(column) - ((zone - 1) % 3) * 8 + 1) * 1e5 + x;
  const rest = ((("ABCDEFGHJKLMNPQRSTUV".indexOf(row) - (zone % 2 ? 0 : 5)) + 20) % 20) * 1e5 + y;
  const south = 8 * BANDS.indexOf(band) - 80; // of its band
  const low = (south < 0 ? 1e7 : 0) + south * 110_900;
  return fromUtm(zone, south < 0, east, rest + 2e6 * Math.ceil((low - 1e5 - rest) / 2e6));
}

// [lon, lat] of what somebody typed: decimal degrees (latitude first), degrees with minutes and seconds, UTM, MGRS; null.
export function placeOf(text) {
  const words = text.trim().toUpperCase();
  const grid = /^(\d{1,2})([C-HJ-NP-X])\s*(\d{6})\s*E?\s+(\d{1,8})\s*N?$/.exec(words);
  if (grid) return fromUtm(Number(grid[1]), grid[2] < "N", Number(grid[3]), Number(grid[4]));
  const square = /^(\d{1,2})([C-HJ-NP-X])\s*([A-HJ-NP-Z])([A-HJ-NP-V])\s*((?:\d\s*)*)$/.exec(words);
  const digits = square?.[5].replace(/\s/g, "");
  if (square && digits.length <= 10 && digits.length % 2 === 0) return fromMgrs(Number(square[1]), square[2], square[3], square[4], digits);
  const angle = "([NSEW])?\\s*([-+]?\\d+(?:\\.\\d+)?)\\s*°?(?:\\s*(\\d+(?:\\.\\d+)?)\\s*[′'])?(?:\\s*(\\d+(?:\\.\\d+)?)\\s*[″\"])?\\s*([NSEW])?";
  const both = new RegExp(`^${angle}(?:\\s*[,;]\\s*|\\s+)${angle}$`).exec(words);
  if (!both) return null;
  const value = ([before, degrees, minutes, seconds, after]) => (degrees.startsWith("-") || /[SW]/.test(before ?? after ?? "") ? -1 : 1) * (Math.abs(Number(degrees)) + Number(minutes ?? 0) / 60 + Number(seconds ?? 0) / 3600);
  const [lat, lon] = [value(both.slice(1, 6)), value(both.slice(6, 11))];
  return Math.abs(lat) <= 85 && Math.abs(lon) <= 180 ? [lon, lat] : null;
}

export function positionText(lat, away, form) {
  const lon = wrapped(away);
  if (form === "dms") return `${dms(lat, "N", "S")} ${dms(lon, "E", "W")}`;
  if (form === "utm") {
    const grid = utm(lat, lon);
    if (grid) return `${grid.zone}${grid.band} ${grid.east.toFixed(0)} E ${grid.north.toFixed(0)} N`;
  }
  if (form === "mgrs") {
    const grid = mgrs(lat, lon);
    if (grid) return grid;
  }
  return `${lat.toFixed(6)}, ${lon.toFixed(6)}`;
}
