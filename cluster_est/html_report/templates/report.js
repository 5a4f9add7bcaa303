// Shows values under the pointer, zooms and enlarges; everything is drawn already, and nothing is fetched.
"use strict";
const charts = (() => {
  const UNITS = 10000; // places across a plot and up a plot, as in its paths
  const points = new WeakMap(), drawn = new WeakMap();

  // ---- scales: whole[0] is the value at the low end of a plot as drawn, whole[1] at its high end

  function scaleOf(text) {
    const [low, high, log] = text.split(" ");
    return log ? { low: Math.log10(low), high: Math.log10(high), log: true } : { low: +low, high: +high };
  }
  const valueAt = (scale, place) => {
    const value = scale.low + (place / UNITS) * (scale.high - scale.low);
    return scale.log ? 10 ** value : value;
  };
  function shown(value, span) {
    const digits = Math.max(1, Math.min(9, Math.ceil(Math.log10(Math.abs(value) / (span / 2000) + 1e-300)) || 1));
    return String(Number(value.toPrecision(digits))).replace("-", "\u2212");
  }
  function ticks(low, high, count) {
    const raw = (high - low) / (1.35 * count), power = 10 ** Math.floor(Math.log10(raw));
    const step = [1, 2, 5, 10].map((each) => each * power).find((each) => each >= raw * (1 - 1e-9));
    const decimals = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
    const found = [];
    for (let i = Math.ceil(low / step); i <= Math.floor(high / step); i += 1) {
      const text = i === 0 ? "0" : Math.abs(i * step) < 1e5 && decimals < 7 ? (i * step).toFixed(decimals) : String(Number((i * step).toPrecision(8)));
      found.push([i * step, text.replace("-", "\u2212")]);
    }
    return found.length < 2 ? ticks(low, high, count + 1) : found;
  }

  // ---- points of a path, read back once

  function pointsOf(path) {
    if (points.has(path)) return points.get(path);
    const found = [];
    for (const part of path.getAttribute("d").split("M").slice(1)) {
      let numbers = (part.match(/-?\d+/g) || []).map(Number);
      if (part.includes("h")) numbers.length = 2;
      if (part.includes("H")) numbers = [(numbers[0] + numbers[2]) / 2, numbers[1]]; // the top of a bar
      let x = 0, y = 0;
      for (let i = 0; i + 1 < numbers.length; i += 2) found.push([(x += numbers[i]), UNITS - (y += numbers[i + 1])]);
    }
    points.set(path, found);
    return found;
  }
  function nearest(path, place) {
    let best = null;
    for (const each of pointsOf(path)) if (!best || Math.abs(each[0] - place) < Math.abs(best[0] - place)) best = each;
    return best;
  }

  // ---- every sample of a record, for those who zoom in: unpacked once

  const records = new Map([...document.querySelectorAll("data.record")].map((each) => [each.dataset.name, each]));
  const unpacked = new Map();

  function samplesOf(chart) {
    const record = records.get(chart.dataset.record);
    if (!record || unpacked.has(record)) return unpacked.get(record);
    const names = record.dataset.curves.split(" "), begin = +record.dataset.begin, step = +record.dataset.step;
    const numbers = new Float32Array(Uint8Array.from(atob(record.value), (sign) => sign.charCodeAt(0)).buffer);
    const count = numbers.length / names.length, found = { time: new Float64Array(count) };
    names.forEach((name, i) => (found[name] = numbers.subarray(i * count, (i + 1) * count)));
    for (let i = 0, at = begin; i < count; i += 1) found.time[i] = step ? begin + i * step : (at += found.step[i]);
    unpacked.set(record, found);
    return found;
  }
  // The values of a curve in a plot, as a function of the number of a sample.
  function valuesOf(samples, plot, name) {
    if (!samples || !samples[name] || name === "time" || name === "step") return null;
    return plot.dataset.called ? (i) => samples.measured[i] - samples[name][i] : (i) => samples[name][i];
  }
  // Draw what lies between two values of x: each sample, or the extremes of each column where they are many.
  function detail(path, samples, value, x, y, [low, high], columns) {
    const { time } = samples, count = time.length, kept = [], found = [];
    let first = 0, last = count - 1;
    while (first < count - 1 && time[first + 1] < low) first += 1;
    while (last > 0 && time[last - 1] > high) last -= 1;
    const many = last - first > 2 * columns;
    for (let i = first; i <= last; ) {
      let end = i + 1, least = i, most = i;
      const column = Math.floor(((time[i] - low) / (high - low)) * columns);
      while (many && end <= last && Math.floor(((time[end] - low) / (high - low)) * columns) === column) {
        if (!(value(least) <= value(end))) least = end;
        if (!(value(most) >= value(end))) most = end;
        end += 1;
      }
      kept.push(Math.min(least, most));
      if (least !== most) kept.push(Math.max(least, most));
      i = end;
    }
    let text = "", pen = "M";
    for (const i of kept) {
      if (!Number.isFinite(value(i))) { pen = "M"; continue; }
      const at = (UNITS * (time[i] - x.low)) / (x.high - x.low), up = (UNITS * (value(i) - y.low)) / (y.high - y.low);
      found.push([at, up]);
      text += `${pen}${at.toFixed(3)} ${(UNITS - up).toFixed(3)}`;
      pen = "L";
    }
    if (!drawn.has(path)) drawn.set(path, path.getAttribute("d"));
    path.setAttribute("d", text);
    points.set(path, found);
  }
  function asDrawn(path) {
    if (!drawn.has(path)) return;
    path.setAttribute("d", drawn.get(path));
    points.delete(path);
  }
  const read = (plot) => [...plot.querySelectorAll("path[data-name]")].filter((path) => getComputedStyle(path).display !== "none");

  // ---- one chart: a window [left, right] of places that all of its plots show

  function live(chart) {
    const plots = [...chart.querySelectorAll(".plot")].filter((plot) => plot.dataset.x && plot.dataset.y);
    if (!plots.length) return;
    const x = scaleOf(plots[0].dataset.x);
    const first = plots.map((plot) => ({ axis: plot.querySelector(".x-axis")?.innerHTML, upright: plot.querySelector(".y-axis").innerHTML, grid: plot.querySelector(".grid").getAttribute("d") }));
    const tip = document.createElement("div"), choice = document.createElement("div");
    tip.className = "tip";
    choice.className = "choice";
    tip.hidden = choice.hidden = true;
    chart.append(tip);
    const cursors = plots.map((plot) => {
      const line = document.createElement("div");
      line.className = "cursor";
      line.hidden = true;
      plot.append(line);
      return line;
    });
    let view = [0, UNITS], from = null;

    const share = (plot, event) => {
      const box = plot.getBoundingClientRect();
      return Math.min(1, Math.max(0, (event.clientX - box.left) / box.width));
    };
    const place = (part) => view[0] + part * (view[1] - view[0]);

    function entry(name, ink, text) {
      const row = document.createElement("div"), label = document.createElement("b");
      label.className = ink;
      label.textContent = name;
      row.append(label, " " + text);
      return row;
    }
    function hover(plot, event) {
      const part = share(plot, event), at = place(part);
      const rows = [];
      let found = null;
      for (const each of plots) {
        const y = scaleOf(each.dataset.y);
        for (const path of read(each)) {
          const point = nearest(path, at);
          if (!point || point[0] < view[0] - 1 || point[0] > view[1] + 1) continue;
          const ink = [...path.classList].slice(1).join(" ");
          const name = (path.dataset.name || "") + (each.dataset.called ? ", " + each.dataset.called : "");
          if (path.dataset.name) rows.push(entry(name, ink, shown(valueAt(y, point[1]), Math.abs(y.high - y.low))));
          if (found === null || Math.abs(point[0] - at) < Math.abs(found - at)) found = point[0];
        }
      }
      if (found === null) return leave();
      const below = chart.querySelector(".below")?.textContent || "";
      tip.replaceChildren(entry(below, "faint", shown(valueAt(x, found), Math.abs(x.high - x.low))), ...rows);
      tip.hidden = false;
      const box = plot.getBoundingClientRect(), own = chart.getBoundingClientRect();
      const left = box.left - own.left + part * box.width;
      tip.style.left = (part < 0.5 ? left + 14 : Math.max(0, left - 14 - tip.offsetWidth)) + "px";
      tip.style.top = box.top - own.top + 8 + "px";
      for (const line of cursors) {
        line.hidden = false;
        line.style.left = (100 * (found - view[0])) / (view[1] - view[0]) + "%";
      }
    }
    function leave() {
      tip.hidden = true;
      for (const line of cursors) line.hidden = true;
    }

    function written(plot, kind, side, places) {
      const box = plot.querySelector(kind);
      if (!box) return;
      box.replaceChildren(...places.map(([at, text]) => {
        const span = document.createElement("span");
        span.style[side] = 100 * at + "%";
        span.textContent = text;
        return span;
      }));
    }
    // The heights that are seen between two places, with a margin.
    function heights(plot) {
      let low = Infinity, high = -Infinity;
      for (const path of read(plot)) {
        for (const [at, up] of pointsOf(path)) {
          if (at < view[0] || at > view[1]) continue;
          low = Math.min(low, up);
          high = Math.max(high, up);
        }
      }
      if (!(high > low)) return [0, UNITS];
      const margin = 0.06 * (high - low);
      return [low - margin, high + margin];
    }
    function show(next) {
      view = next;
      const whole = view[0] === 0 && view[1] === UNITS;
      chart.dataset.view = whole ? "" : `${valueAt(x, view[0])} ${valueAt(x, view[1])}`;
      const samples = whole ? null : samplesOf(chart);
      plots.forEach((plot, number) => {
        const svg = plot.querySelector("svg"), y = scaleOf(plot.dataset.y);
        for (const path of plot.querySelectorAll("path[data-name]")) {
          const value = valuesOf(samples, plot, path.dataset.name);
          if (value) detail(path, samples, value, x, y, view.map((each) => valueAt(x, each)), plot.clientWidth);
          else asDrawn(path);
        }
        const [low, high] = whole ? [0, UNITS] : heights(plot);
        svg.setAttribute("viewBox", `${view[0]} ${UNITS - high} ${view[1] - view[0]} ${high - low}`);
        const grid = plot.querySelector(".grid");
        if (whole) {
          if (first[number].axis !== undefined) plot.querySelector(".x-axis").innerHTML = first[number].axis;
          plot.querySelector(".y-axis").innerHTML = first[number].upright;
          return grid.setAttribute("d", first[number].grid);
        }
        const across = ticks(valueAt(x, view[0]), valueAt(x, view[1]), Math.max(3, Math.round(plot.clientWidth / 100)));
        const up = ticks(valueAt(y, low), valueAt(y, high), Math.max(2, Math.round(plot.clientHeight / 40)));
        const right = across.map(([value, text]) => [(value - x.low) / (x.high - x.low), text]);
        const raised = up.map(([value, text]) => [(value - y.low) / (y.high - y.low), text]);
        grid.setAttribute("d", right.map(([at]) => `M${at * UNITS} ${UNITS - high}v${high - low}`).join("") +
          raised.map(([at]) => `M${view[0]} ${UNITS - at * UNITS}h${view[1] - view[0]}`).join(""));
        written(plot, ".x-axis", "left", right.map(([at, text]) => [(at * UNITS - view[0]) / (view[1] - view[0]), text]));
        written(plot, ".y-axis", "bottom", raised.map(([at, text]) => [(at * UNITS - low) / (high - low), text]));
      });
    }

    for (const plot of plots) {
      plot.addEventListener("pointerdown", (event) => {
        if (x.log || event.button) return;
        from = share(plot, event);
        plot.append(choice);
        plot.setPointerCapture(event.pointerId);
      });
      plot.addEventListener("pointermove", (event) => {
        hover(plot, event);
        if (from === null) return;
        const to = share(plot, event);
        choice.hidden = false;
        choice.style.left = 100 * Math.min(from, to) + "%";
        choice.style.width = 100 * Math.abs(to - from) + "%";
      });
      plot.addEventListener("pointerup", (event) => {
        const to = share(plot, event), begin = from;
        from = null;
        choice.hidden = true;
        if (begin === null || Math.abs(to - begin) < 0.02) return;
        show([place(Math.min(begin, to)), place(Math.max(begin, to))]);
        leave();
      });
      plot.addEventListener("pointercancel", () => ((from = null), (choice.hidden = true)));
      plot.addEventListener("pointerleave", leave);
      plot.addEventListener("dblclick", () => show([0, UNITS]));
    }
  }

  for (const chart of document.querySelectorAll(".chart.zooms")) live(chart);

  // ---- the charts of the experiments

  const form = document.querySelector(".controls");
  const panels = [...document.querySelectorAll(".panel")];

  function size(panel, wide) {
    panel.classList.toggle("wide", wide);
    panel.querySelector("button.size").textContent = wide ? "smaller" : "larger";
    for (const plot of panel.querySelectorAll(".plot")) {
      plot.dataset.height ??= plot.style.height;
      plot.style.height = parseFloat(plot.dataset.height) * (wide ? 1.7 : 1) + "px";
    }
  }
  for (const panel of panels) {
    const button = panel.querySelector("button.size");
    button.hidden = false;
    button.addEventListener("click", () => size(panel, !panel.classList.contains("wide")));
  }
  if (form) {
    form.querySelector(".hint").hidden = false;
    form.addEventListener("submit", (event) => event.preventDefault());
    form.addEventListener("change", (event) => {
      const { name, value, checked } = event.target;
      if (name !== "experiment") return document.body.classList.toggle("hide-" + name, !checked);
      const few = panels.filter((panel) => panel.dataset.experiment === value);
      for (const panel of panels) {
        panel.hidden = value !== "" && !few.includes(panel);
        if (few.includes(panel)) size(panel, true);
      }
    });
  }
  if (document.body.dataset.reload) {
    setTimeout(() => location.reload(), 1000 * Number(document.body.dataset.reload));
  }
  return { pointsOf, samplesOf, scaleOf, valueAt };
})();

