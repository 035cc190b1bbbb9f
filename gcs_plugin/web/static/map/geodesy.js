// Distances and areas on the ground, small enough for a local plane on the ellipsoid: below 0.1 % within 50 km.

const A = 6378137.0;
const E2 = 0.00669437999014;
const RAD = Math.PI / 180;

// Metres a degree of longitude and latitude at a latitude.
function scaleAt(lat) {
  const w = 1 - E2 * Math.sin(lat * RAD) ** 2;
  return [(RAD * A * Math.cos(lat * RAD)) / Math.sqrt(w), (RAD * A * (1 - E2)) / w ** 1.5];
}

// A difference of longitudes the short way round.
const acrossDeg = (deg) => deg - 360 * Math.round(deg / 360);

export function lengthOf(points) {
  let sum = 0;
  for (let k = 1; k < points.length; k++) {
    const [x, y] = scaleAt((points[k][1] + points[k - 1][1]) / 2);
    sum += Math.hypot(acrossDeg(points[k][0] - points[k - 1][0]) * x, (points[k][1] - points[k - 1][1]) * y);
  }
  return sum;
}

export function areaOf(ring) {
  if (ring.length < 3) return 0;
  const [x, y] = scaleAt(ring.reduce((sum, p) => sum + p[1], 0) / ring.length);
  let twice = 0;
  ring.forEach((p, k) => {
    const q = ring[(k + 1) % ring.length];
    twice += (p[0] - ring[0][0]) * (q[1] - ring[0][1]) - (q[0] - ring[0][0]) * (p[1] - ring[0][1]);
  });
  return (Math.abs(twice) / 2) * x * y;
}

export function circle([lng, lat], radius_m, corners = 48) {
  const [x, y] = scaleAt(lat);
  const ring = Array.from({ length: corners }, (_, k) => {
    const a = (2 * Math.PI * k) / corners;
    return [lng + (radius_m * Math.cos(a)) / x, lat + (radius_m * Math.sin(a)) / y];
  });
  return [...ring, ring[0]];
}

// Whether two edges of a ring cross each other.
export function crossesItself(ring) {
  const side = (a, b, c) => Math.sign((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]));
  const n = ring.length;
  for (let i = 0; i < n; i++) {
    for (let j = i + 2; j < n; j++) {
      if (i === 0 && j === n - 1) continue;
      const [a, b, c, d] = [ring[i], ring[i + 1], ring[j], ring[(j + 1) % n]];
      if (side(a, b, c) * side(a, b, d) < 0 && side(c, d, a) * side(c, d, b) < 0) return true;
    }
  }
  return false;
}
