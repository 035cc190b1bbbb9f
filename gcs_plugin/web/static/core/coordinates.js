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
export function utm(lat, lon) {
  if (!(lat >= -80 && lat <= 84)) return null;
  const zone = zoneOf(lat, lon);
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
