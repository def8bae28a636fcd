// The table of all units: the page holds its columns, and of its rows draws those in the window. Nothing is fetched.
(() => {
  "use strict";
  const HEIGHT = 28, SPARE = 12, PAPER = 200;
  const table = JSON.parse(document.getElementById("table-of-units").textContent);
  const by = (id) => document.getElementById(id);
  const box = document.querySelector(".rows"), head = box.querySelector("thead"), body = box.querySelector("tbody");
  const number = (v) => (v === null || v === undefined ? "–" : Math.abs(v) < 1e4 && (v === 0 || Math.abs(v) >= 1e-4) ? v.toPrecision(4) : String(v));
  const worst = (columns) => table.unit.map((_, k) => {
    const known = columns.map((column) => column[k]).filter((v) => v !== null);
    return known.length ? Math.max(...known) : null;
  });
  const plain = (name, values, text, width) => ({ name, values, text, width, left: true });
  const figure = (name, values) => ({ name, values, text: (k) => number(values[k]), width: 8 });
  const status = table.unit.map((_, k) => (table.state[k] ? "failed" : table.odd[k] ? "odd" : "done"));
  const why = table.unit.map((_, k) => table.why[k] || "");
  const lot = table.lot.map((k) => table.lots[k]);
  const verdict = table.verdict.map((k) => table.verdicts[k]);
  const longest = (values, least, most) => Math.min(values.reduce((wide, v) => Math.max(wide, v.length), least), most);
  const first = [plain("unit", table.unit, (k) => table.unit[k], longest(table.unit, 6, 22))];
  if (lot.some(Boolean)) first.push(plain("lot", lot, (k) => lot[k], longest(lot, 5, 14)));
  if (table.date.some(Boolean)) first.push(plain("date", table.date, (k) => table.date[k].slice(0, 10), 11));
  first.push(plain("state", status, (k) => status[k], 7));
  const judged = table.verdict.some((v) => table.verdicts[v] !== "not judged");
  if (judged) first.push(plain("limits", verdict, (k) => verdict[k], 12));
  const heading = (f, axis) => `${f.name}${axis ? ` ${axis}` : ""} [${f.unit}]`;
  const alone = table.axes.length < 2;
  const axes = (f) => f.columns.map((column, k) => figure(heading(f, alone ? "" : table.axes[k]), column));
  const short = (name, values) => ({ ...figure(name, values), text: (k) => (values[k] === null ? "–" : String(values[k])) });
  const soak = [short("from [°C]", table.low), short("to [°C]", table.high), short("at rest [h]", table.hours)];
  const more = Object.entries(table.more).map(([name, values]) => plain(name, values, (k) => values[k], longest(values, 6, 18)));
  const choices = new Map();
  if (!alone) choices.set("worst axis of each", table.figures.map((f) => figure(heading(f, ""), worst(f.columns))));
  else choices.set("all figures", table.figures.flatMap(axes));
  for (const f of table.figures) choices.set(f.name, axes(f));
  choices.set("all", [...table.figures.flatMap(axes), ...soak, ...more]);
  choices.set("recordings", [...soak, ...more]);
  const reason = plain("why", why, (k) => why[k], 60);
  let columns = [], order = [], sorted = { name: "", down: false };

  const fill = (select, options) => select.replaceChildren(...options.map(([value, text]) => new Option(text, value)));
  fill(by("lot"), [["", "all"], ...table.lots.map((name, k) => [String(k), name || "no lot"])]);
  fill(by("verdict"), [["", "all"], ...table.verdicts.map((name, k) => [String(k), name])]);
  fill(by("columns"), [...choices.keys()].map((name) => [name, name]));
  by("lot").parentElement.hidden = table.lots.length < 2;
  by("verdict").parentElement.hidden = !judged;

  const kept = () => {
    const text = by("find").value.trim().toLowerCase(), inLot = by("lot").value, said = by("verdict").value, state = by("state").value;
    return table.unit.map((_, k) => k).filter((k) =>
      (!text || table.unit[k].toLowerCase().includes(text) || why[k].toLowerCase().includes(text))
      && (inLot === "" || table.lot[k] === Number(inLot))
      && (said === "" || table.verdict[k] === Number(said))
      && (!state || (state === "odd" ? table.odd[k] : state === "failed" ? table.state[k] : !table.odd[k] && !table.state[k])));
  };
  const compare = new Intl.Collator("en", { numeric: true }).compare;
  // what is not known comes last, whichever way
  const arranged = (rows) => {
    const column = columns.find((one) => one.name === sorted.name);
    if (!column) return rows;
    const v = column.values, sign = sorted.down ? -1 : 1;
    const none = (k) => v[k] === null || v[k] === undefined || v[k] === "";
    return rows.sort((a, b) => none(a) - none(b) || (none(a) ? 0 : sign * (typeof v[a] === "number" ? v[a] - v[b] : compare(v[a], v[b]))) || a - b);
  };

  const cell = (column, k) => {
    const td = document.createElement("td");
    const text = column.text(k);
    if (column.left) td.className = "left";
    if (column.name === "unit" && table.links[k]) {
      const link = document.createElement("a");
      link.href = table.links[k];
      link.textContent = text;
      td.append(link);
    } else td.textContent = text;
    if (column.name === "limits" && ["pass", "fail", "undecided"].includes(text)) td.classList.add(text);
    if (column.name === "state" && text === "failed") td.classList.add("fail");
    if (column.name === "state" && text === "odd") td.classList.add("unknown");
    if (column.left && text.length > column.width) td.title = text;
    return td;
  };
  const row = (k) => {
    const tr = document.createElement("tr");
    tr.append(...columns.map((column) => cell(column, k)));
    return tr;
  };
  const gap = (rows) => {
    const tr = document.createElement("tr");
    tr.className = "gap";
    tr.setAttribute("aria-hidden", "true");
    const td = document.createElement("td");
    td.colSpan = columns.length;
    td.style.height = `${rows * HEIGHT}px`;
    tr.append(td);
    return tr;
  };
  let drawn = "";
  const draw = (force) => {
    const start = Math.max(0, Math.floor(box.scrollTop / HEIGHT) - SPARE);
    const stop = Math.min(order.length, start + Math.ceil(box.clientHeight / HEIGHT) + 2 * SPARE);
    if (!force && drawn === `${start} ${stop}`) return;
    drawn = `${start} ${stop}`;
    body.replaceChildren(gap(start), ...order.slice(start, stop).map(row), gap(order.length - stop));
  };
  const heads = () => {
    const tr = document.createElement("tr");
    tr.append(...columns.map((column) => {
      const th = document.createElement("th"), button = document.createElement("button");
      button.type = "button";
      button.textContent = column.name;
      button.title = "sort";
      if (column.left) th.className = "left";
      th.style.width = `${column.width + 2.5}ch`;
      th.setAttribute("aria-sort", sorted.name !== column.name ? "none" : sorted.down ? "descending" : "ascending");
      button.onclick = () => {
        sorted = { name: column.name, down: sorted.name === column.name && !sorted.down };
        show();
        [...head.querySelectorAll("button")].find((one) => one.textContent === column.name).focus();
      };
      th.append(button);
      return th;
    }));
    head.replaceChildren(tr);
  };
  const show = () => {
    columns = [...first, ...choices.get(by("columns").value), ...(why.some(Boolean) ? [reason] : [])];
    order = arranged(kept());
    by("count").textContent = `${order.length.toLocaleString("en")} of ${table.unit.length.toLocaleString("en")} units`;
    box.scrollTop = 0;
    heads();
    box.style.setProperty("--filled", `${head.offsetHeight + HEIGHT * (order.length + 1)}px`);
    draw(true);
  };
  box.addEventListener("scroll", () => draw(false), { passive: true });
  addEventListener("resize", () => draw(true));
  for (const id of ["find", "lot", "state", "verdict", "columns"]) by(id).addEventListener("input", show);
  addEventListener("beforeprint", () => {
    const some = order.slice(0, PAPER);
    body.replaceChildren(...some.map(row));
    document.querySelector(".paper").textContent = some.length < order.length ? `The first ${some.length} of ${order.length.toLocaleString("en")} units that are chosen; the page itself has them all.` : "";
  });
  addEventListener("afterprint", () => draw(true));
  box.classList.toggle("long", longest(table.unit, 0, 99) > 16);
  show();
})();
