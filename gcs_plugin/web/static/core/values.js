// Any value may come over the air: what is out of range becomes null here, so that nothing behind has to ask again.

const MERCATOR_DEG = 85.05;

export const number = (value, low = -1e12, high = 1e12) =>
  typeof value === "number" && Number.isFinite(value) && value >= low && value <= high ? value : null;

export const text = (value, most = 200) => (value == null || typeof value === "object" ? "" : String(value).slice(0, most));

export const position = (lon, lat) => {
  const [x, y] = [number(lon, -180, 180), number(lat, -MERCATOR_DEG, MERCATOR_DEG)];
  return x == null || y == null ? null : [x, y];
};

// Corners east or west of the meridian of 180 degrees go on counting (181), so that a ring stays in one piece.
const corner = (lon, lat) => {
  const turns = 360 * Math.round((number(lon, -540, 540) ?? 0) / 360);
  const place = position(number(lon, -540, 540) == null ? null : lon - turns, lat);
  return place && [lon, place[1]];
};
const points = (list) => (Array.isArray(list) ? list.map((p) => Array.isArray(p) && corner(p[0], p[1])).filter(Boolean) : []);
export const ring = (list) => points(list);

const object = (value) => (value && typeof value === "object" && !Array.isArray(value) ? value : {});
const count = (value) => number(value, 0, 1e9) ?? 0;

function flight(row) {
  const given = object(row.flight);
  if (given.text || given.state) return { state: text(given.state), text: text(given.text || given.state), item: count(given.item), items: count(given.items) };
  const mission = object(row.mission);
  return { state: "", text: text(row.landed), item: count(mission.item), items: count(mission.items) };
}

export const MOST_TEXTS = 50;

export function messages(list) {
  if (!Array.isArray(list)) return [];
  return list.slice(-MOST_TEXTS).map((m) => (typeof m === "string" ? { text: text(m, 300), time: null, severity: 6 }
    : { text: text(object(m).text, 300), time: number(object(m).time), severity: number(object(m).severity, 0, 7) ?? 6 })).filter((m) => m.text);
}

// A vehicle as the page keeps it. Messages hold what has changed, so that `before` gives the rest; a whole row replaces
// it, and what that leaves out is over.
export function vehicle(message, before, now, whole = false) {
  const row = { ...(whole ? {} : before?.raw ?? {}), ...message };
  const moved = position(row.lon_deg, row.lat_deg);
  const trail = Array.isArray(message.trail) ? points(message.trail) : (before?.trail ?? []);
  if (moved && !Array.isArray(message.trail)) extend(trail, moved);
  delete row.trail;
  delete row.texts;
  const battery = number(row.battery, 0, 1.5);
  const frames = object(row.frames);
  return {
    raw: row, id: text(row.id), name: text(row.name) || before?.name || text(row.id), system: number(row.system, 0, 255),
    linked: number(row.system, 0, 255) != null, state: text(row.state), mode: text(row.mode), armed: row.armed === true, landed: text(row.landed),
    alarm: typeof row.alarm === "string" ? text(row.alarm, 300) : null, behind: text(row.behind, 300), ordered: row.behind_ordered === true, alt_m: number(row.alt_m, -5000, 60000),
    flight: flight(row), position: moved ?? before?.position ?? null, height_m: number(row.height_m, -5000, 50000),
    speed_m_s: number(row.speed_m_s, 0, 1000), climb_m_s: number(row.climb_m_s, -100, 100), roll_deg: number(row.roll_deg, -180, 180), pitch_deg: number(row.pitch_deg, -180, 180), gimbal_deg: number(row.gimbal_pitch_deg, -180, 180), heading_deg: number(row.heading_deg, -720, 720), battery,
    battery_left_s: number(row.battery_left_s, 0, 1e6), gps_fix: number(row.gps_fix, 0, 10), satellites: number(row.satellites, 0, 254),
    link: text(row.link), silent_s: number(row.silent_s, 0) ?? 0, at: now, photos: count(row.photos),
    came_s: number(row.came_s, 0), last_seq: number(row.last_seq, 0), last_frame: text(row.last_frame), frames: { frames: count(frames.frames), fine: count(frames.fine), coarse: count(frames.coarse), rejected: count(frames.rejected) },
    sortie: count(row.sortie), route: count(row.route), item: count(object(row.mission).item), phase: text(object(row.mission).phase), returnsAfter: Array.isArray(row.returns_after) ? row.returns_after.map(String) : null, takeoff: row.takeoff ? { in_s: number(row.takeoff.in_s), failed: text(row.takeoff.failed) } : null,
    texts: Array.isArray(message.texts) ? messages(message.texts) : (before?.texts ?? []), home: Array.isArray(row.home) ? position(row.home[1], row.home[0]) : null, trail, autopilot: text(row.autopilot), fence: fence(row.fence),
    faults: { lost: number(object(row.faults).lost_share, 0, 1) ?? 0, damaged: count(object(row.faults).damaged), impossible: count(object(row.faults).impossible) },
  };
}

// The geofence that a vehicle holds; a circle as its centre and radius. Null until the vehicle has told it.
function fence(given) {
  if (!given || typeof given !== "object") return null;
  const zones = (Array.isArray(given.zones) ? given.zones : []).map(object).map((zone) => ({ inside: zone.kind === "inclusion", ring: points(zone.ring),
    center: Array.isArray(zone.center) ? position(zone.center[0], zone.center[1]) : null, radius_m: number(zone.radius_m, 0, 1e6) }));
  return { read_s: number(given.read_s), zones: zones.filter((zone) => zone.ring.length > 2 || (zone.center && zone.radius_m)) };
}

// A mission that a vehicle holds: points [item, longitude, latitude].
export function route(row) {
  const points = (Array.isArray(row?.points) ? row.points : []).filter((p) => Array.isArray(p) && number(p[0], 0) != null && position(p[1], p[2]));
  return { vehicle: text(row?.vehicle), route: number(row?.route, 0) ?? 0, points };
}

// An aircraft that carries ADS-B, as the daemon heard of it.
export function aircraft(row) {
  return { id: text(row?.id), name: text(row?.name, 12) || text(row?.id), position: position(row?.lon_deg, row?.lat_deg), alt_m: number(row?.alt_m, -5000, 60000),
    heading_deg: number(row?.heading_deg, 0, 360), speed_m_s: number(row?.speed_m_s, 0, 2000) };
}

const TRAIL = 600;
const STEP_DEG = 1e-5; // a metre

function extend(trail, point) {
  const last = trail.at(-1);
  if (last && Math.abs(last[0] - point[0]) < STEP_DEG && Math.abs(last[1] - point[1]) < STEP_DEG) return;
  trail.push(point);
  if (trail.length > TRAIL) trail.splice(0, trail.length - TRAIL);
}

// Seconds since a vehicle was heard, as of now (nowMs()); null for one that only sends pictures.
export const age = (row, now) => (row.linked ? row.silent_s + (now - row.at) / 1000 : null);
