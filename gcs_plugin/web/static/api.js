// The daemon's API: token, requests, and the stream of events that reconnects by itself.

const KEY = "orthoswarm-token";
const said = new URLSearchParams(location.hash.slice(1)).get("token");
if (said) {
  sessionStorage.setItem(KEY, said);
  history.replaceState(null, "", location.pathname);
}

export const token = () => sessionStorage.getItem(KEY) || "";
export const setToken = (text) => sessionStorage.setItem(KEY, text.trim());

const headers = () => (token() ? { Authorization: `Bearer ${token()}` } : {});

async function answer(response) {
  const text = await response.text();
  const body = text ? JSON.parse(text) : null;
  if (!response.ok) {
    const detail = body && body.detail;
    throw new Error(typeof detail === "string" ? detail : `the daemon answered ${response.status}`);
  }
  return body;
}

export const get = async (path) => answer(await fetch(path, { headers: headers() }));

export const post = async (path, body = {}) =>
  answer(await fetch(path, { method: "POST", headers: { "Content-Type": "application/json", ...headers() }, body: JSON.stringify(body) }));

export const requestTile = (url) => ({ url: new URL(url, location.href).href, headers: headers() });

// Calls heard(event) for each event, and state(true or false) as the connection comes and goes.
export function listen(heard, state) {
  let wait = 500;
  const connect = () => {
    const query = token() ? `?token=${encodeURIComponent(token())}` : "";
    const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/api/events${query}`);
    socket.onopen = () => { wait = 500; state(true); heard({ type: "resync" }); };
    socket.onmessage = (message) => heard(JSON.parse(message.data));
    socket.onclose = () => { state(false); setTimeout(connect, wait); wait = Math.min(8000, wait * 2); };
  };
  connect();
}
