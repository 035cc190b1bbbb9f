// Who has which vehicle, where several people can fly: it is asked for, and handed over by the one who has it.

import { request } from "/static/core/api.js";
import { button, keyedList, make, setHidden, setText } from "/static/core/dom.js";
import { notice } from "/static/core/notices.js";
import { state, subscribe } from "/static/core/store.js";
import { t } from "/static/core/strings.js";
import { onLink } from "/static/fly/need.js";
import { may } from "/static/people/me.js";

const nameOf = (id) => state.vehicles.get(id)?.name ?? id;
const holdOf = (vehicle) => state.holds.find((row) => row.vehicle === vehicle);
const mine = (person) => person?.id === state.me?.id;

async function change(vehicle, act) {
  try {
    await request("POST", `/api/holds/${encodeURIComponent(vehicle)}`, { act });
  } catch (error) {
    notice("bad", t("people.failed", { why: error.message }));
  }
}

// Rows of a list: a sentence and the buttons that go with it.
function rowsIn(list) {
  const draw = keyedList(list, () => make("li", {}, make("span", {}), make("span", { class: "row" })), (row, [words, acts, vehicle]) => {
    setText(row.firstChild, words);
    const key = acts.join();
    if (row.dataset.acts === key) return;
    row.dataset.acts = key;
    row.lastChild.replaceChildren(...acts.map((act) => button(t(`holds.${act === "free" ? "release" : act}`), () => change(vehicle, act === "ask" ? "take" : act), { class: "small", dataset: { act } })));
  });
  return (rows) => draw(rows.map((row) => [row[2], row]));
}

// What one has to answer, has asked, or has chosen on the map: over the map, while it lasts.
export function holdBox() {
  const list = make("ul", { class: "holds", role: "status", hidden: true });
  const draw = rowsIn(list);
  subscribe("holds me selected vehicles", "vehicles in hand", () => {
    const rows = [];
    for (const { vehicle, pilot, asked } of state.holds) {
      const names = { vehicle: nameOf(vehicle), name: pilot.name };
      if (mine(pilot) && asked) rows.push([t("holds.asks", { ...names, name: asked.name }), ["give", "keep"], vehicle]);
      else if (mine(asked)) rows.push([t("holds.asked", names), [], vehicle]);
      else if (vehicle === state.selected && !mine(pilot) && may("pilot")) rows.push([t("holds.has", names), ["ask"], vehicle]);
    }
    draw(state.me?.several ? rows : []);
    setHidden(list, !state.me?.several || !rows.length);
  });
  return list;
}

// All vehicles, for the dialog.
export function holdList() {
  const list = make("ul", { class: "holds" });
  const box = make("section", {}, make("h3", {}, t("holds.title")), list);
  const draw = rowsIn(list);
  subscribe("holds me vehicles", "all vehicles in hand", () => {
    setHidden(box, !state.me?.several);
    if (!state.me?.several) return;
    draw([...state.vehicles.values()].filter(onLink).map(({ id }) => {
      const hold = holdOf(id);
      const words = !hold ? `${nameOf(id)}: ${t("holds.free")}` : mine(hold.pilot) ? t("holds.yours", { vehicle: nameOf(id) }) : t("holds.has", { name: hold.pilot.name, vehicle: nameOf(id) });
      return [words, !may("pilot") ? [] : !hold ? ["take"] : mine(hold.pilot) ? ["free"] : mine(hold.asked) ? [] : ["ask"], id];
    }));
  });
  return box;
}
