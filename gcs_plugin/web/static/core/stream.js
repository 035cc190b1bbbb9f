// The daemon's event stream. A heartbeat comes each second: silence is shown, never hidden behind the last state.

import { token } from "/static/core/api.js";
import { changed, state } from "/static/core/store.js";

const LATE_S = 2;
export const LOST_S = 5;
const RECONNECT_S = 8;
const CHECK_MS = 500;

let heardAt = performance.now();
let offset_s = null; // the daemon's clock less performance.now()
let socket = null;
let wait = 500;

// The daemon's time now (epoch seconds), null before its first heartbeat.
export const daemonTime = () => (offset_s == null ? null : offset_s + performance.now() / 1000);
export const connected = () => socket?.readyState === WebSocket.OPEN && state.link !== "lost";

// A heartbeat that was held up on its way would set the clock back: only a large step back is the daemon's own.
const SLIP_S = 0.05;
const STEP_S = 60;
function setClock(offset) {
  offset_s = offset_s == null || offset < offset_s - STEP_S ? offset : Math.max(offset, offset_s - SLIP_S);
}

export function listen(heard) {
  const connect = () => {
    const query = token() ? `?token=${encodeURIComponent(token())}` : "";
    const opened = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/api/events${query}`);
    socket = opened;
    opened.onopen = () => { wait = 500; };
    opened.onmessage = (message) => {
      heardAt = performance.now();
      if (state.link !== "live") check();
      let event = null;
      try { event = JSON.parse(message.data); } catch { return; }
      if (!event || typeof event !== "object") return;
      if (Number.isFinite(event.time) && (event.type === "heartbeat" || event.type === "hello")) setClock(event.time - heardAt / 1000);
      if (event.type !== "heartbeat") heard(event.type === "hello" ? { type: "resync" } : event);
    };
    opened.onclose = () => {
      if (socket !== opened) return;
      setTimeout(connect, wait);
      wait = Math.min(4000, wait * 2);
    };
  };
  const check = () => {
    const silent = (performance.now() - heardAt) / 1000;
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
      heardAt = Math.min(heardAt, performance.now() - RECONNECT_S * 1000);
      setTimeout(connect, 500);
    }
  };
  setInterval(check, CHECK_MS);
  connect();
}
