// The daemon's HTTP: token, requests, and failures that say what to do.

import { t } from "/static/core/strings.js";

const KEY = "orthoswarm-token";
const fragment = new URLSearchParams(location.hash.slice(1));
const [given, invitation] = ["token", "invitation"].map((name) => fragment.get(name));
if (given) sessionStorage.setItem(KEY, given);
if (given || invitation) history.replaceState(null, "", location.pathname);

export const token = () => sessionStorage.getItem(KEY) || "";
export const setToken = (text) => sessionStorage.setItem(KEY, text.trim());

const headers = () => (token() ? { Authorization: `Bearer ${token()}` } : {});

// kind: "http" the daemon answered no (status), "time" it did not answer in time, "network" it could not be reached.
class ApiError extends Error {
  constructor(message, kind, status = 0) {
    super(message);
    Object.assign(this, { kind, status });
  }
}

export async function request(method, path, body, limit_ms = 30_000) {
  const control = new AbortController();
  const timer = setTimeout(() => control.abort(), limit_ms);
  const plain = body !== undefined && !(body instanceof Blob);
  const options = {
    method, signal: control.signal, cache: "no-store",
    headers: { ...(plain ? { "Content-Type": "application/json" } : {}), ...headers() },
    body: body === undefined ? undefined : plain ? JSON.stringify(body) : body,
  };
  try {
    const response = await fetch(path, options);
    const text = await response.text();
    let answer = null;
    try { answer = text ? JSON.parse(text) : null; } catch { /* no JSON: the status says enough */ }
    if (response.ok) return answer;
    const detail = typeof answer?.detail === "string" ? answer.detail : t("api.status", { status: response.status });
    throw new ApiError(detail, "http", response.status);
  } catch (error) {
    if (error instanceof ApiError) throw error;
    if (error?.name === "AbortError") throw new ApiError(t("api.late"), "time");
    throw new ApiError(t("api.unreachable"), "network");
  } finally {
    clearTimeout(timer);
  }
}

export const get = (path) => request("GET", path);
export const post = (path, body = {}, limit_ms = 60_000) => request("POST", path, body, limit_ms);
// A picture of the daemon for an <img>, without the token in its address.
export async function picture(path) {
  const response = await fetch(path, { headers: headers() });
  if (!response.ok) throw new ApiError(t("api.status", { status: response.status }), "http", response.status);
  return URL.createObjectURL(await response.blob());
}
export const withToken = (path) => (token() ? `${path}?token=${encodeURIComponent(token())}` : path);
export const tileRequest = (url) => ({ url: new URL(url, location.href).href, headers: headers() });

// An invitation is exchanged once for a cookie, which no script reads; before that nothing else is asked.
export let joinProblem = "";
if (invitation) {
  // from then on this tab belongs to who was invited
  await request("POST", "/api/session", { invitation }).then(() => sessionStorage.removeItem(KEY), (error) => { joinProblem = error.message; });
}
