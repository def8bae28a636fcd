// A live run on its page: asks its server once a second and shows what has come; goes on when the server is back.
(() => {
  "use strict";
  const find = (id) => document.getElementById(id);
  const PERIOD = 1000, PATIENCE = 5000; // ms
  const signs = { good: "✓", waiting: "…", warning: "!", bad: "✕" };
  const about = JSON.parse(find("about").textContent);
  const tab = Math.random().toString(36).slice(2);
  const kept = { whole: { generation: -1, rows: [] }, last: { generation: -1, rows: [] } };
  let run = null, ended = false, shown = { of: "whole", seconds: Infinity }, status = null;

  const say = (id, text) => { const at = typeof id === "string" ? find(id) : id; if (at.textContent !== text) at.textContent = text; };
  const value = (id, text, unit) => { // the unit is smaller than the number
    const at = typeof id === "string" ? find(id) : id;
    if (at.textContent === `${text} ${unit}`) return;
    at.replaceChildren(`${text} `, Object.assign(document.createElement("small"), { textContent: unit }));
  };
  const known = (v) => v !== null && v !== undefined && Number.isFinite(v);
  const fixed = (v, n) => (known(v) ? v.toLocaleString("en", { minimumFractionDigits: n, maximumFractionDigits: n }) : "–");
  const signed = (v, n) => (known(v) ? (v < 0 ? "−" : "+") + fixed(Math.abs(v), n) : "–");
  const bias = (v) => (!known(v) ? "–" : about.unit.fixed ? fixed(v, 2) : String(Number(v.toPrecision(6))));
  const long = (s) => {
    if (!known(s)) return "–";
    const whole = Math.floor(s), two = (v) => String(v).padStart(2, "0");
    return `${Math.floor(whole / 3600)}:${two(Math.floor(whole / 60) % 60)}:${two(whole % 60)}`;
  };
  const made = (tag, ...parts) => { const element = document.createElement(tag); element.append(...parts); return element; };
  // commands and keys stand in backticks
  const prose = (text) => text.split(/`([^`]+)`/).map((part, k) => (k % 2 ? made("code", part) : part));
  const list = (id, lines) => find(id).replaceChildren(...lines.map((text) => made("li", ...prose(text))));

  async function ask(path) {
    const answer = await fetch(path, { signal: AbortSignal.timeout(PATIENCE), cache: "no-store" });
    if (!answer.ok) throw new Error(`${path}: ${answer.status}`);
    return answer;
  }

  // the rows that came since, and again the last that we have: it may have changed
  async function rows(last) {
    const mine = kept[shown.of];
    const answer = await ask(`/history?of=${shown.of}&generation=${mine.generation}&rows=${mine.rows.length}&tab=${tab}${last ? "&last=1" : ""}`);
    const all = new Float64Array(await answer.arrayBuffer());
    const [generation, at, columns, width] = all;
    if (at > mine.rows.length) { mine.generation = -1; return; }
    Object.assign(mine, { generation, width });
    mine.rows.length = at;
    for (let k = 4; k < all.length; k += columns) mine.rows.push(all.subarray(k, k + columns));
  }

  function state(level, words) {
    const at = find("state");
    if (at.dataset.level !== level) say("spoken", words); // not every second of "no data for 12 s"
    at.dataset.level = level;
    const [short, why] = words.split(/: (.*)/);
    say("sign", signs[level]);
    say("words", short);
    say("why", why || "");
    document.title = `${signs[level]} ${short}`;
  }

  function numbers(s) {
    const factor = about.unit.factor, biases = s[about.keys.bias] || [], sigmas = s[about.keys.sigma] || [];
    for (const at of document.querySelectorAll("[data-bias]")) {
      const k = Number(at.dataset.bias);
      if (known(biases[k])) value(at, bias(biases[k] * factor), about.unit.shown); else say(at, "–");
      say(at.nextElementSibling, known(sigmas[k]) ? `± ${bias(sigmas[k] * factor)} ${about.unit.shown}, one sigma` : "\u00a0");
    }
    value("temperature", fixed(s.temperature_degC, 2), "°C");
    say("rate", known(s.temperature_rate_K_s) ? `${signed(s.temperature_rate_K_s * 60, 3)} K/min` : "\u00a0");
    say("nis", fixed(s.nis_per_component, 2));
    say("bounds", known(s.nis_low) ? `1 where the model is right (95 %: ${fixed(s.nis_low, 2)} to ${fixed(s.nis_high, 2)})` : "1 where the model is right");
    value("pace", fixed(s.samples_per_s, 1), "a second");
    say("samples", `${fixed(s.samples, 0)} in all`);
    value("lost", fixed(s.lost, 0), "samples");
    const sent = s.samples + s.lost;
    say("share", sent ? `${Number(((100 * s.lost) / sent).toPrecision(2))} % of what was sent` : "\u00a0");
    say("time", long(s.t_s));
    say("recorded", s.recording ? `${fixed(s.recorded, 0)} rows in ${s.recording}` : "not recorded");
    find("notes").hidden = !s.lines.length;
    list("lines", s.lines);
    say("count", String(s.lines.length));
    say("latest", s.lines.at(-1) || "\u00a0");
  }

  // stretches of time in which something was so, and the gaps, as shades; every gap breaks the lines
  function table(silent) {
    const mine = kept[shown.of], n = about.names.length;
    const index = Object.fromEntries(about.names.map((name, k) => [name, k]));
    const end = mine.rows.length ? mine.rows[mine.rows.length - 1][0] : 0;
    const chosen = mine.rows.filter((row) => row[0] >= end - shown.seconds);
    const steps = chosen.slice(-60).map((row, k, all) => (k ? row[0] - all[k - 1][0] : NaN)).filter(Number.isFinite).sort((a, b) => a - b);
    const gap = Math.max(2, 2.5 * mine.width, 3 * (steps[steps.length >> 1] || 0));
    const zero = chosen.length && chosen[0][0] > 1e6 ? chosen[0][0] : 0;
    const columns = Array.from({ length: n }, () => []), shades = [];
    const mark = (start, stop, text, role) => {
      const before = shades.findLast((s) => s.text === text);
      if (before && before.stop >= start) before.stop = stop; else shades.push({ start, stop, text, role });
    };
    let before = null;
    for (const row of chosen) {
      const t = row[0] - zero, from = before === null ? t : before;
      if (t - from > gap) {
        columns.forEach((column, k) => column.push(k ? null : (from + t) / 2));
        mark(from, t, "no data", "hole");
      } else {
        if (row[index.moving_high]) mark(from, t, "moving", "moving");
        if (row[index.refused_high]) mark(from, t, "refused", "refused");
      }
      columns.forEach((column, k) => column.push(k ? (Number.isFinite(row[k]) ? row[k] : null) : t));
      before = t;
    }
    if (silent && before !== null) { // what is shown goes on to now
      columns.forEach((column, k) => column.push(k ? null : before + silent));
      mark(before, before + silent, "no data", "hole");
    }
    const lasts = columns[0].length ? columns[0][columns[0].length - 1] - columns[0][0] : 0;
    const [unit, size] = lasts > 3 * 3600 ? ["h", 3600] : lasts > 600 ? ["min", 60] : ["s", 1];
    return {
      x: columns[0].map((t) => t / size), column: (name, factor = 1) => columns[index[name]].map((v) => (v === null ? null : v * factor)),
      shades: shades.map((s) => ({ ...s, start: s.start / size, stop: s.stop / size })), label: `time [${unit}]`,
    };
  }

  function update(id, content) {
    find(id).hidden = !content.panels.length;
    const chart = find(id).querySelector("figure").chart;
    if (chart && content.panels.length) chart.update(content);
  }

  function figures(s) {
    const found = table(s.no_data_s), { x, column, shades, label } = found;
    const some = (values) => values.some((v) => v !== null);
    find("empty").hidden = x.length > 0;
    const factor = about.unit.factor, unit = about.unit.shown;
    const line = (name, role, y, more) => ({ name, role, style: "line", x: 0, ...(y && { y }), ...more });
    const panel = (text, lines, more) => ({ label: text, log: false, height: 1, lines, shades, rules: [], ...more });
    const biases = x.length < 2 ? [] : about.axes.map((axis, k) => {
      const y = column(`bias_${k}`, factor), sigma = column(`sigma_${k}`, factor);
      const around = (sign) => y.map((v, i) => (v === null ? null : v + sign * 2 * sigma[i]));
      return panel(`${axis} bias [${unit}]`, [
        line("± 2 sigma", "sigma", undefined, { low: around(-1), high: around(1) }),
        line("least to most", "estimate", undefined, { low: column(`bias_${k}_low`, factor), high: column(`bias_${k}_high`, factor) }),
        line("estimate", "estimate", y),
      ]);
    });
    const others = [];
    if (x.length > 1) {
      const T = column("temperature");
      if (some(T)) {
        others.push(panel("temperature [°C]", [line("temperature", "temperature", T)]));
        others.push(panel("its rate [K/min]", [line("rate", "other", column("temperature_rate", 60))]));
      }
      const rules = [{ y: 1, text: "", role: "reference" }];
      if (known(s.nis_low)) rules.push({ y: s.nis_low, text: "", role: "limit" }, { y: s.nis_high, text: "95 %", role: "limit" });
      others.push(panel("NIS per component, mean of 100 updates [1]", [line("NIS", "nis", column("nis"))], { rules }));
      others.push(panel("samples a second [1/s]", [line("samples a second", "data", column("samples_per_s"))], { height: 0.7 }));
      others.push(panel("lost so far [samples]", [line("lost", "data", column("lost"))], { height: 0.7 }));
    }
    update("biases", { title: "", label, log: false, x: [x], panels: biases });
    update("others", { title: "", label, log: false, x: [x], panels: others });
    map(s.map, s.map_lines || []);
  }

  function map(m, lines) {
    find("map").hidden = !m;
    if (!m) return;
    list("map-lines", lines);
    const figure = find("map").querySelector("figure"), factor = about.unit.factor;
    figure.hidden = !m.curve;
    if (!m.curve || !figure.chart) return;
    const T = [...m.curve.temperature_degC], sigma = [...m.curve[about.keys.sigma]], wanted = m[about.keys.sigma_wanted];
    const unknown = about.axes.map(() => null), [low, high] = m.range_degC || [Infinity, -Infinity];
    if (low < T[0]) { T.unshift(low); sigma.unshift(unknown); } // what was not seen yet is to be seen
    if (high > T[T.length - 1]) { T.push(high); sigma.push(unknown); }
    figure.chart.update({
      title: "", label: "temperature [°C]", log: false, x: [T],
      // a panel an axis: in one of three alike the last would hide the others
      panels: about.axes.map((axis, k) => ({
        label: `sigma of the map, ${axis} [${about.unit.shown}]`, log: false, height: 0.8,
        lines: [{ name: "sigma", role: "estimate", style: "line", x: 0, y: sigma.map((row) => (known(row[k]) ? row[k] * factor : null)) }],
        shades: (m.missing_degC || []).map(([start, stop]) => ({ start, stop, text: "not seen yet", role: "hole" })),
        rules: known(wanted) ? [{ y: wanted * factor, text: "wanted", role: "limit" }] : [],
      })),
    });
  }

  function finished(s) {
    const { failed, lines, out } = s.ended;
    ended = true;
    find("ended").hidden = false;
    find("ended").classList.add(failed ? "fail" : "pass");
    state(failed ? "bad" : "good", failed ? "ended with an error" : "finished");
    say("how", failed ? "The run failed" : `Finished, results are in ${out}`);
    list("found", lines);
  }

  async function turn() {
    try {
      const s = await (await ask(`/status.json?tab=${tab}`)).json();
      if (run !== null && s.run !== run) { location.reload(); return; }
      run = s.run;
      if (s.state !== undefined) {
        status = s;
        await rows(Boolean(s.ended));
        find("numbers").classList.toggle("old", s.no_data_s > 0);
        if (!s.ended) state(s.level, s.state);
        numbers(s);
        if (!document.hidden) figures(s);
      }
      if (s.ended) finished(s);
    } catch (problem) {
      if (!(problem instanceof TypeError || problem instanceof DOMException)) console.error(problem);
      if (ended) return;
      find("numbers").classList.add("old");
      state("bad", "connection to driftlab lost, trying again");
    }
  }

  async function forever() {
    await turn();
    setTimeout(forever, PERIOD);
  }

  for (const button of document.querySelectorAll("#span button")) {
    button.onclick = async () => {
      for (const one of document.querySelectorAll("#span button")) one.setAttribute("aria-pressed", String(one === button));
      shown = { of: button.dataset.of, seconds: Number(button.dataset.seconds) || Infinity };
      for (const figure of document.querySelectorAll("figure.chart")) figure.chart.span = null;
      await rows(false).catch(() => null); // what was shown before, until the server is back
      if (status) figures(status);
    };
  }
  document.addEventListener("visibilitychange", () => { if (!document.hidden && status) figures(status); });
  document.addEventListener("DOMContentLoaded", forever);
})();
