// The daemon's event stream. A heartbeat comes each second: silence is shown, never hidden behind the last state.

import { token } from "/static/core/api.js";
import { nowMs } from "/static/core/clock.js";
import { changed, state } from "/static/core/store.js";

const LATE_S = 2;
export const LOST_S = 5;
const RECONNECT_S = 8;
const CHECK_MS = 500;

let heardAt = performance.now(); // for the clocks of commands
let quietSince = nowMs(); // for what is shown
let socket = null;
let wait = 500;
export const connected = () => socket?.readyState === WebSocket.OPEN && state.link !== "lost";

// Seconds of a clock of the daemon, less performance.now(). A heartbeat that was held up on its way would set the clock
// back: it slips slowly. Three in a row that are far behind were not held up; the daemon's clock was set.
const SLIP_S = 0.05;
const FAR_S = 1;
const STEP_BEATS = 3;
const clock = () => ({ offset_s: null, behind: 0 });
function setClock(held, time_s, maySteps = true) {
  const offset = time_s - heardAt / 1000;
  held.behind = maySteps && held.offset_s != null && offset < held.offset_s - FAR_S ? held.behind + 1 : 0;
  held.offset_s = held.offset_s == null || held.behind >= STEP_BEATS ? offset : Math.max(offset, held.offset_s - SLIP_S);
}
const read = (held) => (held.offset_s == null ? null : held.offset_s + performance.now() / 1000);

let wall = clock(); // epoch seconds: the daemon's machine may set it at any time
let steady = clock(); // nobody sets it; it counts within one run of the daemon
let run = null;
function heardClocks(event) {
  if (event.run !== run) { run = event.run ?? null; wall = clock(); steady = clock(); }
  if (Number.isFinite(event.time)) setClock(wall, event.time);
  if (Number.isFinite(event.clock_s)) setClock(steady, event.clock_s, false);
}

// When a command is given, by the daemon's clocks, for its age: without a time before the first heartbeat.
export const given = () => (read(steady) == null ? { given_s: read(wall) } : { given_clock_s: read(steady), run, given_s: read(wall) });

export function listen(heard) {
  const connect = () => {
    const query = token() ? `?token=${encodeURIComponent(token())}` : "";
    let welcome = false;
    const opened = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/api/events${query}`);
    socket = opened;
    opened.onopen = () => { wait = 500; welcome = true; };
    opened.onmessage = (message) => {
      heardAt = performance.now();
      quietSince = nowMs();
      if (state.link !== "live") check();
      let event = null;
      try { event = JSON.parse(message.data); } catch { return; }
      if (!event || typeof event !== "object") return;
      if (event.type === "heartbeat" || event.type === "hello") heardClocks(event);
      if (event.type !== "heartbeat") heard(event.type === "hello" ? { type: "resync" } : event);
    };
    opened.onclose = () => {
      if (socket !== opened) return;
      if (!welcome) heard({ type: "unwelcome" }); // no link, or a wrong token: a request tells which
      setTimeout(connect, wait);
      wait = Math.min(4000, wait * 2);
    };
  };
  const check = () => {
    const silent = (nowMs() - quietSince) / 1000;
    const link = silent < LATE_S ? "live" : silent < LOST_S ? "late" : "lost";
    if (link !== state.link || link !== "live") {
      state.link = link;
      state.silent_s = silent;
      changed("link");
    }
    if (silent > RECONNECT_S && socket?.readyState === WebSocket.OPEN) {
      const dead = socket;
      socket = null;
      dead.close();
      quietSince = Math.min(quietSince, nowMs() - RECONNECT_S * 1000);
      setTimeout(connect, 500);
    }
  };
  setInterval(check, CHECK_MS);
  document.addEventListener("visibilitychange", check);
  connect();
}
