// Draws what the page holds: nothing is fetched, and a plot is drawn when it comes into view.
"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const printing = window.matchMedia("print");
  const PAPER = 660; // pixels between the margins of A4 or Letter
  const NARROW = 520;
  let onPaper = false;
  const drawn = new Map();

  function colours() {
    const style = getComputedStyle(document.documentElement);
    const found = {};
    for (const name of ["page", "line", "text", "muted", "faint", "measured", "before", "after", "band"]) {
      found["$" + name] = style.getPropertyValue("--" + name).trim();
    }
    found["$diverging"] = [[0, found["$before"]], [0.5, found["$page"]], [1, found["$after"]]];
    found["$sequential"] = [[0, found["$line"]], [1, found["$after"]]];
    return found;
  }

  function themed(value, theme) {
    if (typeof value === "string") return value in theme ? theme[value] : value;
    if (Array.isArray(value)) return value.map((each) => themed(each, theme));
    if (value === null || typeof value !== "object" || ArrayBuffer.isView(value)) return value;
    return Object.fromEntries(Object.entries(value).map(([key, each]) => [key, themed(each, theme)]));
  }

  // Base64 of little-endian numbers; 32-bit ones are differences from an offset.
  function numbers(packed) {
    const text = atob(packed.f8 ?? packed.f4);
    const bytes = Uint8Array.from(text, (sign) => sign.charCodeAt(0));
    if (packed.f8 !== undefined) return new Float64Array(bytes.buffer);
    return Float64Array.from(new Float32Array(bytes.buffer), (each) => each + packed.offset);
  }

  function layoutOf(own, theme, height) {
    const axes = {};
    for (const name of Object.keys(own).filter((key) => /^[xy]axis\d*$/.test(key))) {
      axes[name] = {
        gridcolor: theme["$line"], zerolinecolor: theme["$line"], linecolor: theme["$faint"],
        automargin: true, ...own[name],
        title: { font: { size: 12, color: theme["$muted"] }, standoff: 8, ...own[name].title },
      };
    }
    const size = onPaper ? { width: PAPER, height } : { height };
    return {
      ...size, paper_bgcolor: theme["$page"], plot_bgcolor: theme["$page"],
      font: { family: "system-ui, sans-serif", size: 12, color: theme["$text"] },
      margin: { l: 8, r: 8, t: 26, b: 8 }, hovermode: "x unified", dragmode: "zoom",
      hoverlabel: { bgcolor: theme["$page"], bordercolor: theme["$line"] },
      colorway: [theme["$before"], "#6a8f3c", "#8e5ea8", "#3b9aa8", "#b8862b", "#a8506b", theme["$muted"], theme["$after"], "#7a5c3e", "#4f8f7b"],
      legend: { orientation: "h", x: 0, y: 1.0, yanchor: "bottom", font: { color: theme["$muted"] } },
      ...own, ...axes,
    };
  }

  function plot(place, given, layout) {
    const theme = colours();
    const narrow = place.clientWidth < NARROW;
    const traces = narrow ? given.map(({ texttemplate, ...each }) => each) : given;
    const made = layoutOf(themed(layout, theme), theme, Number(place.dataset.height));
    if (narrow) tighten(traces, made);
    const options = { displaylogo: false, responsive: true, displayModeBar: false };
    return Plotly.react(place, themed(traces, theme), made, options);
  }

  // On a phone, there is no room for texts in the cells of a map and below its columns.
  function tighten(traces, layout) {
    if (!traces.some((each) => each.type === "heatmap" && each.customdata)) return;
    layout.xaxis.showticklabels = false;
    layout.height = Math.max(260, layout.height - 60);
  }

  function drawFigure(place) {
    const figure = data.figures[place.dataset.figure];
    return plot(place, figure.traces, figure.layout);
  }

  // ---- the curves of one output of one experiment

  const form = document.querySelector(".controls");
  const curves = document.getElementById("curves-plot");

  function panelNow() {
    const outputs = data.experiments[Number(form.experiment.value)].outputs;
    return outputs[Number(form.output.value)] ?? outputs[0];
  }

  function listOutputs() {
    const outputs = data.experiments[Number(form.experiment.value)].outputs;
    const before = form.output.selectedOptions[0]?.textContent;
    form.output.replaceChildren(...outputs.map((each, index) => new Option(each.name, index)));
    const same = outputs.findIndex((each) => each.name === before);
    form.output.value = String(Math.max(same, 0));
    form.output.parentElement.hidden = outputs.length < 2;
  }

  const escaped = (text) => text.replace(/&/g, "&amp;").replace(/</g, "&lt;");

  function line(panel, name, x, y, more) {
    const under = name === "measured"; // wide and pale, so that a curve that follows it hides nothing
    return {
      x: numbers(panel[x]), y: numbers(panel[y]), type: "scatter", mode: "lines", name,
      visible: form[name].checked, opacity: under ? 0.5 : 1,
      line: { color: "$" + name, width: under ? 3.5 : 1.4 }, ...more,
    };
  }

  function tracesOf(panel) {
    if (panel.distance !== undefined) {
      return [{ ...line(panel, "after", "segment", "distance"), yaxis: "y2", name: "distance" }];
    }
    const few = panel.t.f8.length < 2200;
    const points = few ? { mode: "lines+markers", marker: { size: 3.5 } } : {};
    const found = [line(panel, "measured", "t", "measured", points)];
    for (const name of ["before", "after"]) {
      if (panel[name] === undefined) continue;
      const fine = panel[name + "_fine"] !== undefined;
      found.push(line(panel, name, fine ? "t_fine" : "t", fine ? name + "_fine" : name));
      const rest = { yaxis: "y2", showlegend: false, name: name + ", residual" };
      found.push({ ...line(panel, name, "t", name + "_residual"), ...rest });
    }
    return found;
  }

  function drawCurves() {
    const panel = panelNow();
    const alone = panel.distance !== undefined;
    const layout = {
      xaxis: { title: { text: alone ? "segment" : "time (s)" }, anchor: "y2" },
      yaxis: { title: { text: escaped(panel.label) }, domain: [0.36, 1], visible: !alone },
      yaxis2: {
        title: { text: alone ? "distance, relative" : "residual" + (panel.unit ? ` (${escaped(panel.unit)})` : "") },
        domain: alone ? [0, 1] : [0, 0.28],
      },
      uirevision: form.experiment.value + "/" + form.output.value,
    };
    const shown = data.experiments[Number(form.experiment.value)].id;
    form.dataset.shown = `Experiment ${shown}, output ${panel.name}`;
    const traces = tracesOf(panel);
    for (const name of ["measured", "before", "after"]) {
      form[name].parentElement.hidden = panel[name] === undefined;
    }
    return plot(curves, traces, layout);
  }

  // ---- when

  function draw(place) {
    const maker = place === curves ? drawCurves : () => drawFigure(place);
    drawn.set(place, maker);
    return maker();
  }

  const places = [...document.querySelectorAll(".plot")];
  for (const place of places) place.style.minHeight = place.dataset.height + "px";
  if (form) {
    listOutputs();
    form.addEventListener("change", (event) => {
      if (event.target === form.experiment) listOutputs();
      draw(curves);
    });
    form.addEventListener("submit", (event) => event.preventDefault());
  }
  const watcher = new IntersectionObserver(
    (entries) => {
      for (const { target, isIntersecting } of entries) {
        if (!isIntersecting) continue;
        watcher.unobserve(target);
        if (!drawn.has(target)) draw(target);
      }
    },
    { rootMargin: "300px" },
  );
  for (const place of places) watcher.observe(place);
  dark.addEventListener("change", () => drawn.forEach((maker) => maker()));
  const print = (on) => {
    onPaper = on;
    if (on) places.forEach((place) => draw(place));
    else drawn.forEach((maker) => maker());
  };
  window.addEventListener("beforeprint", () => print(true));
  window.addEventListener("afterprint", () => print(false));
  printing.addEventListener("change", (event) => print(event.matches));
  if (document.body.dataset.reload) {
    setTimeout(() => location.reload(), 1000 * Number(document.body.dataset.reload));
  }
})();
