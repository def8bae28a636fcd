// Draws the charts of a page with uPlot: figures of the class chart, each with its content as JSON in a script.
// One chart is a column of panels over one x: zoom, cursor and legend are shared. Times are plain numbers.
const driftlab = (() => {
  "use strict";
  const dark = () => {
    const chosen = document.documentElement.dataset.theme;
    return chosen ? chosen === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  };
  const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const fade = (colour, share) => colour + Math.round(share * 255).toString(16).padStart(2, "0");
  const dashes = { dashed: [7, 4], dotted: [2, 3] };
  const LABEL = 12; // characters of a name under an axis
  const digits = (v) => (v === null || v === undefined ? "–" : Number(v.toPrecision(5)).toLocaleString("en", { maximumSignificantDigits: 5 }));
  // which lines of a logarithmic axis have their number: of many decades these alone, of few their 2 and 5, else all
  const labelled = (axis) => (u, splits) => {
    const { min, max } = u.scales[axis], many = max / min > 300;
    if (max / min < 5) return splits;
    return splits.map((v) => (["1", ...(many ? [] : ["2", "5"])].includes(v.toExponential(0).split("e")[0]) ? v : null));
  };

  class Chart {
    constructor(figure, content, looks) {
      Object.assign(this, { figure, content, looks, hidden: new Set(), plots: [], span: null });
      this.body = figure.querySelector(".panels");
      this.names = content.named ? JSON.parse(document.getElementById(content.named).textContent) : null;
      const known = Object.values(this.names ?? {});
      this.last = Number(Object.keys(this.names ?? {}).at(-1) ?? -1) + 1;
      this.longest = known.reduce((wide, name) => Math.max(wide, ...name.split("\n").map((part) => Math.min(part.length, LABEL))), 5);
      this.dated = known.some((name) => name.includes("\n"));
      this.keys = figure.querySelector(".keys");
      this.read = figure.querySelector(".read");
      figure.querySelector(".reset").onclick = () => this.zoom(null);
      this.body.tabIndex = 0;
      this.body.addEventListener("keydown", (event) => this.key(event));
      this.legend();
      this.draw();
      new ResizeObserver(() => this.resize()).observe(this.body);
    }

    // what a value of x is called: a number, or the one of so many; of many a page has some names, and the places of others
    called(v) { return this.names?.[v - 1] ?? (!this.names || (Number.isInteger(v) && v >= 1 && v <= this.last) ? digits(v) : ""); }

    // pixels from one number or name under an axis to the next, at least
    apart() { return this.names ? 16 + 7 * this.longest : 50; }

    // under an axis there is no room for long names: of serial numbers the ends differ; a date stands below
    label(v) { return this.called(v).toString().split("\n").map((name) => (name.length > LABEL ? `…${name.slice(1 - LABEL)}` : name)).join("\n"); }

    // pixels under the last panel
    foot() { return this.dated ? 48 : 34; }

    colour(role) { return this.looks[role][dark() ? "dark" : "light"]; }

    // the widths that a panel has are those of the page, or of the paper
    width() { return this.paper || Math.max(this.body.clientWidth, 240); }

    height(panel) {
      const tall = this.content.panels.reduce((sum, p) => sum + p.height, 0);
      const each = Math.min(this.width() < 520 ? 150 : 190, (this.paper ? 640 : 1600) / tall);
      return Math.round(each * panel.height);
    }

    legend() {
      const seen = new Map(), bands = new Map(); // of bands of one role that overlap, the inner ones are darker
      for (const panel of this.content.panels) {
        for (const line of panel.lines) if (line.name && !seen.has(line.name)) seen.set(line.name, line);
        for (const s of panel.shades) if (s.text && !seen.has(s.text)) seen.set(s.text, { ...s, style: "shade" });
      }
      this.keys.replaceChildren(...[...seen].map(([name, line]) => {
        const key = document.createElement("button");
        const mark = document.createElement("span");
        key.type = "button";
        key.className = "key";
        mark.className = "mark " + (line.style || "line") + ("y" in line || line.style === "shade" ? "" : " band");
        const look = this.looks[line.role];
        mark.style.setProperty("--light", look.light);
        mark.style.setProperty("--dark", look.dark);
        mark.style.setProperty("--width", Math.max(2, look.width) + "px");
        if (line.low && !line.y) mark.style.opacity = 0.3 * bands.set(line.role, (bands.get(line.role) || 0) + 1).get(line.role);
        key.append(mark, name);
        key.title = "show or hide";
        key.setAttribute("aria-pressed", "true");
        key.onclick = () => {
          if (!this.hidden.delete(name)) this.hidden.add(name);
          key.setAttribute("aria-pressed", String(!this.hidden.has(name)));
          this.draw();
        };
        return key;
      }));
    }

    draw() {
      for (const plot of this.plots) plot.destroy();
      this.body.replaceChildren();
      const sync = uPlot.sync(Math.random().toString(36));
      this.plots = this.content.panels.map((panel, k) => {
        const label = document.createElement("div");
        label.className = "label";
        label.textContent = panel.label;
        this.body.append(label);
        return this.panel(k, sync);
      });
      if (this.span) this.zoom(this.span);
    }

    panel(k, sync) {
      const panel = this.content.panels[k], last = k === this.content.panels.length - 1;
      const now = () => this.content.panels[k]; // on a live page, that of the moment
      const series = [{}], bands = [], names = [];
      const add = (line, options) => {
        series.push({ label: line.name, show: !this.hidden.has(line.name), spanGaps: false, ...options });
        names.push({ line });
        return series.length - 1;
      };
      for (const line of panel.lines) {
        const colour = this.colour(line.role), look = this.looks[line.role];
        if (line.low && line.high) {
          const none = { stroke: "transparent", width: 0, points: { show: false } };
          const high = add(line, none), low = add(line, none);
          bands.push({ series: [high, low], fill: fade(colour, 0.18) });
        }
        if (!line.y) continue;
        const points = line.style === "points";
        add(line, {
          read: true, stroke: colour, width: points ? 0 : look.width, dash: dashes[line.style],
          points: points ? { show: true, size: 4, stroke: colour, fill: colour, width: 0 } : { show: false },
          paths: points ? () => null : undefined,
        });
      }
      const ink = css("--ink-2"), grid = { stroke: css("--rule"), width: 1 };
      const font = "12px system-ui, sans-serif";
      const options = {
        width: this.width(), height: this.height(panel) + (last ? this.foot() : 0), padding: [6, Math.max(22, this.names ? this.apart() / 2 : 0), last ? 0 : 6, 0],
        legend: { show: false }, bands, series,
        cursor: { sync: { key: sync.key, scales: ["x", null] }, y: false, drag: { x: true, y: false }, points: { size: 7 } },
        scales: { x: { time: false, distr: this.content.log ? 3 : 1, range: this.content.log ? (u, low, high) => [low, high] : undefined }, y: { distr: panel.log ? 3 : 1, range: panel.log ? undefined : (u, low, high) => this.range(now(), low, high) } },
        axes: [
          { stroke: ink, grid, ticks: { ...grid, show: last }, font, size: last ? this.foot() : 0, space: this.apart(), values: last ? (this.names ? (u, v) => v.map((k) => this.label(k)) : undefined) : (u, v) => v.map(() => ""), filter: this.content.log ? labelled("x") : undefined },
          { stroke: ink, grid, ticks: grid, font, size: 62, filter: panel.log ? labelled("y") : undefined },
        ],
        hooks: {
          drawClear: [(u) => this.shade(u, now())],
          draw: [(u) => this.rules(u, now())],
          setCursor: [(u) => { if (u.cursor.event) this.tell(u, panel, series, names); }],
          setScale: [(u, key) => { if (key === "x") this.span = [u.scales.x.min, u.scales.x.max]; }],
        },
      };
      return new uPlot(options, this.data(panel), this.body);
    }

    // the columns of a panel's series, in their order, over one x
    data(panel) {
      const tables = [];
      for (const line of panel.lines) {
        const x = this.content.x[line.x];
        if (line.low && line.high) tables.push([x, line.high], [x, line.low]);
        if (line.y) tables.push([x, line.y]);
      }
      return tables.length ? uPlot.join(tables) : [[0]];
    }

    // a level that is drawn is inside, and a constant has room about it
    range(panel, low, high) {
      if (panel.span) return panel.span;
      const all = [low, high, ...panel.rules.map((r) => r.y)].filter((v) => Number.isFinite(v));
      if (!all.length) return [0, 1];
      low = Math.min(...all); high = Math.max(...all);
      const room = (high - low) * 0.06 || Math.abs(high) * 0.1 || 1;
      return [low - room, high + room];
    }

    shade(u, panel) {
      for (const s of panel.shades) {
        if (this.hidden.has(s.text)) continue;
        const a = u.valToPos(s.start, "x", true), b = u.valToPos(s.stop, "x", true);
        u.ctx.fillStyle = fade(this.colour(s.role), 0.16);
        const left = Math.max(a, u.bbox.left), right = Math.min(Math.max(b, a + 2), u.bbox.left + u.bbox.width);
        if (right > left) u.ctx.fillRect(left, u.bbox.top, right - left, u.bbox.height);
      }
    }

    rules(u, panel) {
      const ratio = devicePixelRatio;
      for (const rule of panel.rules) {
        const y = u.valToPos(rule.y, "y", true);
        if (!(y >= u.bbox.top && y <= u.bbox.top + u.bbox.height)) continue;
        const colour = this.colour(rule.role);
        u.ctx.save();
        u.ctx.strokeStyle = u.ctx.fillStyle = colour;
        u.ctx.lineWidth = ratio;
        u.ctx.setLineDash([4 * ratio, 3 * ratio]);
        u.ctx.beginPath();
        u.ctx.moveTo(u.bbox.left, y);
        u.ctx.lineTo(u.bbox.left + u.bbox.width, y);
        u.ctx.stroke();
        u.ctx.font = `${11 * ratio}px system-ui, sans-serif`;
        u.ctx.textAlign = "right";
        const below = y - 14 * ratio < u.bbox.top; // no room above the line
        u.ctx.textBaseline = below ? "top" : "bottom";
        const place = [rule.text, u.bbox.left + u.bbox.width - 4 * ratio, y + (below ? 3 : -2) * ratio];
        u.ctx.setLineDash([]);
        u.ctx.lineWidth = 4 * ratio;
        u.ctx.strokeStyle = css("--paper"); // a rim, so that it can be read before lines and points
        u.ctx.strokeText(...place);
        u.ctx.fillText(...place);
        u.ctx.restore();
      }
    }

    // what is under the cursor, in words
    tell(u, panel, series, names) {
      const k = u.cursor.idx;
      if (k === null || k === undefined) { this.read.textContent = "\u00a0"; return; }
      const nearest = (column) => {
        for (let d = 0; d < 40; d++) for (const i of [k - d, k + d]) if (Number.isFinite(column[i])) return column[i];
        return null;
      };
      const said = [];
      for (let s = 1; s < series.length; s++) {
        if (!series[s].read || this.hidden.has(series[s].label)) continue;
        const line = names[s - 1].line;
        const band = line.low ? ` (${digits(nearest(u.data[s - 1]))} to ${digits(nearest(u.data[s - 2]))})` : ""; // its low, its high
        const alike = series.filter((other) => other.read && other.label === series[s].label).length > 1;
        said.push(`${series[s].label}${alike ? `, ${line.style}` : ""} ${digits(nearest(u.data[s]))}${band}`);
      }
      this.read.textContent = `${this.content.label} ${this.called(u.data[0][k]).toString().replace("\n", ", ")} · ${panel.label}: ${said.join(", ")}`;
    }

    zoom(span) {
      this.span = span;
      for (const plot of this.plots) {
        const x = plot.data[0];
        plot.setScale("x", span ? { min: span[0], max: span[1] } : { min: x[0], max: x[x.length - 1] });
      }
      if (!span) this.span = null;
    }

    key(event) {
      const x = this.plots[0].scales.x, width = x.max - x.min;
      const moves = {
        "+": [x.min + width / 4, x.max - width / 4], "-": [x.min - width / 2, x.max + width / 2],
        ArrowLeft: [x.min - width / 4, x.max - width / 4], ArrowRight: [x.min + width / 4, x.max + width / 4],
      };
      if (event.key in moves) { this.zoom(moves[event.key]); event.preventDefault(); }
      if (event.key === "Escape") this.zoom(null);
    }

    resize() {
      const width = this.width();
      this.plots.forEach((plot, k) => {
        const last = k === this.plots.length - 1;
        if (plot.width !== width) plot.setSize({ width, height: this.height(this.content.panels[k]) + (last ? this.foot() : 0) });
      });
    }

    // a live page replaces what is shown; the zoom stays where one has chosen it, and a drag goes on
    update(content) {
      const zoomed = this.span && this.plots.length && this.zoomed();
      const legend = JSON.stringify(content.panels.map((p) => [p.lines.map((l) => l.name), p.shades.map((s) => s.text)]));
      const shape = (c) => JSON.stringify([c.log, c.panels.map((p) => [p.label, p.log, p.height,
        p.lines.map((l) => [l.name, l.role, l.style, !l.low, !l.y])])]);
      const same = this.plots.length && shape(content) === shape(this.content);
      this.content = content;
      this.figure.querySelector(".x-label").textContent = content.label;
      if (legend !== this.drawn) { this.drawn = legend; this.legend(); }
      if (!zoomed) this.span = null;
      if (!same) { this.draw(); return; }
      const span = this.span;
      this.plots.forEach((plot, k) => {
        plot.setData(this.data(content.panels[k]), !span);
        if (span) plot.setScale("x", { min: span[0], max: span[1] });
      });
    }

    zoomed() { const x = this.plots[0].data[0]; return this.span[0] > x[0] || this.span[1] < x[x.length - 1]; }
  }

  // a table that is wider than a phone: its rows become cards, each value under its head (`.cards` of page.css)
  const fit = () => {
    for (const table of document.querySelectorAll("table:has(thead):not(.rows table, .lots)")) {
      const heads = [...table.tHead.rows[0].cells].map((cell) => cell.innerText.replace(/\s+/g, " ").trim());
      for (const cell of table.querySelectorAll("tbody td:not([colspan])")) cell.dataset.head = heads[cell.cellIndex];
      table.classList.remove("cards");
      table.classList.toggle("cards", table.scrollWidth > table.clientWidth + 1);
    }
    hint();
  };

  // what is still wider than its place says so, above it
  const hint = () => {
    for (const box of document.querySelectorAll("pre, table, .rows")) {
      const before = box.previousElementSibling, there = before?.classList.contains("hint");
      const wide = box.clientWidth > 0 && box.scrollWidth > box.clientWidth + 1 && getComputedStyle(box).overflowX !== "visible";
      if (there && !wide) before.remove();
      if (wide && !there) box.before(Object.assign(document.createElement("p"), { className: "hint", textContent: "scroll sideways →" }));
    }
  };

  const charts = [];
  const looks = () => JSON.parse(document.getElementById("looks").textContent);
  const start = () => {
    for (const figure of document.querySelectorAll("figure.chart")) {
      const text = figure.querySelector("script").textContent;
      const chart = new Chart(figure, JSON.parse(text), looks());
      figure.chart = chart;
      charts.push(chart);
    }
    const button = document.getElementById("theme");
    if (button) button.onclick = () => { document.documentElement.dataset.theme = dark() ? "light" : "dark"; redraw(); };
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
    fit();
    addEventListener("resize", fit);
    for (const details of document.querySelectorAll("details")) details.addEventListener("toggle", fit);
    let before;
    addEventListener("beforeprint", () => {
      before = document.documentElement.dataset.theme;
      document.documentElement.dataset.theme = "light";
      for (const details of document.querySelectorAll("details")) details.open = true;
      for (const chart of charts) { chart.paper = 680; chart.draw(); }
    });
    addEventListener("afterprint", () => {
      if (before) document.documentElement.dataset.theme = before; else delete document.documentElement.dataset.theme;
      for (const chart of charts) { chart.paper = null; chart.draw(); }
    });
  };
  const redraw = () => charts.forEach((chart) => chart.draw());
  document.addEventListener("DOMContentLoaded", start);
  return { charts };
})();
