// Lists the routes of openapi.json, without any file from the internet.

const api = await (await fetch("/openapi.json")).json();
const routes = document.getElementById("routes");
for (const [path, methods] of Object.entries(api.paths)) {
  for (const [method, about] of Object.entries(methods)) {
    const article = document.createElement("article");
    const name = document.createElement("b");
    name.textContent = method.toUpperCase();
    const where = document.createElement("code");
    where.textContent = path;
    const text = document.createElement("p");
    text.textContent = about.description || about.summary || "";
    const values = document.createElement("p");
    values.textContent = (about.parameters || []).map((p) => `${p.name} (${p.in})${p.description ? `: ${p.description}` : ""}`).join("\n");
    article.append(name, where, text, values);
    routes.append(article);
  }
}
