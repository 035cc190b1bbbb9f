// What this person prefers, kept in this browser.

const KEY = "orthoswarm-settings";
const DEFAULTS = { theme: "dark", language: "auto", units: "metric", coordinates: "decimal", sound: true, speak: false, mode: "fly", sort: "name", folded: false, tall: false };

function load() {
  try {
    return { ...DEFAULTS, ...JSON.parse(localStorage.getItem(KEY) || "{}") };
  } catch {
    return { ...DEFAULTS };
  }
}

export const settings = load();
const listeners = [];
export const onSettings = (work) => { listeners.push(work); };

export function setSetting(name, value) {
  settings[name] = value;
  try { localStorage.setItem(KEY, JSON.stringify(settings)); } catch { /* private browsing: kept until the page closes */ }
  applyTheme();
  for (const work of listeners) work(name);
}

export function applyTheme() {
  document.documentElement.dataset.theme = settings.theme === "sunlight" ? "sunlight" : "dark";
}
