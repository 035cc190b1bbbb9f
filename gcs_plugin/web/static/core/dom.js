// Elements are made once and changed in place: setters touch the page only where a value differs.

export const byId = (id) => document.getElementById(id);

export function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) {
    if (value == null || value === false) continue;
    if (key.startsWith("on")) element.addEventListener(key.slice(2), value);
    else if (key === "class") element.className = value;
    else if (key === "dataset") Object.assign(element.dataset, value);
    else element.setAttribute(key, value === true ? "" : value);
  }
  element.append(...children.filter((child) => child != null && child !== false));
  return element;
}

export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

export function setAttribute(element, name, value) {
  if (value == null || value === false) {
    if (element.hasAttribute(name)) element.removeAttribute(name);
  } else {
    const text = value === true ? "" : String(value);
    if (element.getAttribute(name) !== text) element.setAttribute(name, text);
  }
}

export function setHidden(element, hidden) {
  if (element.hidden !== hidden) element.hidden = hidden;
}

export function setStyle(element, name, value) {
  if (element.style.getPropertyValue(name) !== value) element.style.setProperty(name, value);
}

// A list whose rows stay the same elements: rows(key, item) are made once, updated in place, removed when gone.
export function keyedList(box, create, update) {
  const rows = new Map();
  return (items) => {
    const wanted = new Set(items.map(([key]) => key));
    for (const [key, row] of rows) {
      if (!wanted.has(key)) { row.remove(); rows.delete(key); }
    }
    for (const [key, item] of items) {
      let row = rows.get(key);
      if (!row) { row = create(item, key); rows.set(key, row); box.append(row); }
      update(row, item, key);
    }
    return rows;
  };
}

// A labelled control: <label>text <control></label>.
export const labelled = (text, control, hint) =>
  make("label", { class: "field" }, make("span", {}, text), control, hint ? make("small", {}, hint) : null);

// A field for a number, read with numberOf of units.js. type=number drops the comma of "62,5" in most browsers.
export const numberField = (attributes) => make("input", { type: "text", inputmode: "decimal", autocomplete: "off", ...attributes });

export const button = (text, onclick, options = {}) =>
  make("button", { type: "button", onclick, ...options }, text);

export const choice = (options, value, onchange, label) => {
  const select = make("select", { onchange: () => onchange(select.value), "aria-label": label },
    ...options.map(([key, text]) => make("option", { value: key, selected: key === value }, text)));
  return select;
};
