// Saves each picture as SVG, PNG or CSV: what is seen of it, and the values that it shows.
(() => {
  const SCALE = 3; // pixels of a PNG for each of the screen
  const MARGIN = 10;
  const SPACE = document.querySelector("svg")?.namespaceURI;
  const LEFT_OUT = ".tools, .size, .tip, .cursor, .choice, title";
  const INK = ["fill", "fill-opacity", "stroke", "stroke-opacity", "stroke-width", "stroke-dasharray", "stroke-linecap", "stroke-linejoin"];
  const rounded = (value) => Number(value.toPrecision(8)); // single precision, or a place of a plot
  const escaped = (text) => text.replace(/[&<>"]/g, (sign) => `&#${sign.charCodeAt(0)};`);

  // ---- a figure as SVG: its plots as they are, and everything else at the place where the browser has it

  function svgOf(figure) {
    const whole = figure.getBoundingClientRect(), parts = [];
    const at = (box) => [box.left - whole.left, box.top - whole.top];

    function plot(svg) {
      const box = svg.getBoundingClientRect(), [x, y] = at(box);
      const paths = [...svg.querySelectorAll("path")].filter((path) => getComputedStyle(path).display !== "none").map((path) => {
        const style = getComputedStyle(path), ink = INK.map((name) => `${name}="${style[name]}"`).join(" ");
        return `<path d="${path.getAttribute("d")}" ${ink} vector-effect="non-scaling-stroke"/>`;
      });
      parts.push(`<svg x="${x}" y="${y}" width="${box.width}" height="${box.height}" viewBox="${svg.getAttribute("viewBox")}" preserveAspectRatio="none">${paths.join("")}</svg>`);
    }
    function shape(element, style) { // backgrounds, and the lines of a legend
      const box = element.getBoundingClientRect(), [x, y] = at(box);
      if (!/transparent|, 0\)$/.test(style.backgroundColor) && box.width)
        parts.push(`<rect x="${x}" y="${y}" width="${box.width}" height="${box.height}" rx="${style.borderRadius === "50%" ? box.height / 2 : 0}" fill="${style.backgroundColor}" opacity="${style.opacity}"/>`);
      if (element.tagName === "I" && parseFloat(style.borderTopWidth))
        parts.push(`<path d="M${x} ${y + 1}h${box.width}" stroke="${style.borderTopColor}" stroke-width="2"${style.borderTopStyle === "dashed" ? ' stroke-dasharray="4 3"' : ""}/>`);
    }
    function words(node, style) { // line by line
      const lines = new Map(), range = document.createRange();
      for (const found of node.data.matchAll(/\S+/g)) {
        range.setStart(node, found.index);
        range.setEnd(node, found.index + found[0].length);
        const box = range.getBoundingClientRect(), key = Math.round(box.top);
        if (box.width) lines.has(key) ? lines.get(key).text.push(found[0]) : lines.set(key, { box, text: [found[0]] });
      }
      for (const { box, text } of lines.values()) {
        const [x, y] = at(box), size = parseFloat(style.fontSize), upright = style.writingMode.startsWith("vertical");
        const place = upright ? `transform="translate(${x + box.width / 2 + 0.35 * size} ${y + box.height}) rotate(-90)"` : `x="${x}" y="${y + box.height / 2 + 0.35 * size}"`;
        parts.push(`<text ${place} font-size="${size}" font-weight="${style.fontWeight}" font-family="${escaped(style.fontFamily)}" fill="${style.color}">${escaped(text.join(" "))}</text>`);
      }
    }
    function walk(element) {
      if (element.matches(LEFT_OUT) || element.hidden) return;
      if (element.tagName === "svg") return plot(element);
      const style = getComputedStyle(element);
      if (element !== figure) shape(element, style);
      for (const node of element.childNodes) {
        if (node.nodeType === Node.TEXT_NODE) words(node, style);
        else if (node.nodeType === Node.ELEMENT_NODE) walk(node);
      }
    }
    walk(figure);
    const [width, height] = [whole.width + 2 * MARGIN, whole.height + 2 * MARGIN], size = `width="${width}" height="${height}"`;
    const page = `<rect x="${-MARGIN}" y="${-MARGIN}" ${size} fill="${getComputedStyle(document.body).backgroundColor}"/>`;
    return `<svg xmlns="${SPACE}" ${size} viewBox="${-MARGIN} ${-MARGIN} ${width} ${height}">${page}${parts.join("")}</svg>`;
  }

  // ---- the values of a figure

  function csvOf(figure) {
    const cells = (rows) => rows.map((row) => row.map((cell) => (/[",\n]/.test(cell) ? `"${String(cell).replace(/"/g, '""')}"` : cell)).join(",")).join("\n") + "\n";
    const chart = figure.querySelector(".chart");
    if (!chart) return cells([...figure.querySelectorAll("tr")].map((row) => [...row.children].map((cell) => cell.textContent.trim().replace("\u2212", "-"))));
    const below = chart.querySelector(".below")?.textContent || "x", samples = charts.samplesOf(chart);
    if (samples) {
      const names = ["measured", "before", "after"].filter((name) => samples[name]);
      const rows = Array.from(samples.time, (time, i) => [time, ...names.map((name) => samples[name][i])].map(rounded));
      return cells([[below, ...names], ...rows]);
    }
    const rows = [["plot", "curve", below, "value"]];
    for (const plot of chart.querySelectorAll(".plot")) {
      const x = charts.scaleOf(plot.dataset.x), names = [...plot.querySelectorAll(".y-axis span")].map((each) => each.textContent);
      const y = plot.dataset.y ? charts.scaleOf(plot.dataset.y) : null;
      const label = plot.querySelector(".label")?.textContent || plot.querySelector("title").textContent;
      for (const path of plot.querySelectorAll("path:not(.grid, .rule, .cells)")) {
        const curve = path.dataset.name || path.classList[0];
        for (const [at, up] of charts.pointsOf(path))
          rows.push([label, curve, rounded(charts.valueAt(x, at)), y ? rounded(charts.valueAt(y, up)) : names[Math.floor((1 - up / 10000) * names.length)]]);
      }
    }
    return cells(rows);
  }

  // ---- files

  function save(blob, name) {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(blob);
    link.download = name;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  }
  function png(svg, name) {
    const image = new Image(), canvas = document.createElement("canvas");
    image.onload = () => {
      [canvas.width, canvas.height] = [SCALE * image.width, SCALE * image.height];
      canvas.getContext("2d").drawImage(image, 0, 0, canvas.width, canvas.height);
      canvas.toBlob((blob) => save(blob, name));
    };
    image.src = "data:image/svg+xml;charset=utf-8," + encodeURIComponent(svg);
  }
  const kinds = {
    SVG: (figure, name) => save(new Blob([svgOf(figure)], { type: "image/svg+xml" }), name + ".svg"),
    PNG: (figure, name) => png(svgOf(figure), name + ".png"),
    CSV: (figure, name) => save(new Blob([csvOf(figure)], { type: "text/csv" }), name + ".csv"),
  };
  for (const figure of document.querySelectorAll("figure")) {
    const tools = document.createElement("span"), { experiment, output } = figure.dataset;
    const caption = figure.querySelector("figcaption");
    const name = (experiment ? `${experiment} ${output}` : figure.id || caption.textContent).trim().replace(/[^\w.-]+/g, "_");
    tools.className = "tools";
    for (const [kind, write] of Object.entries(kinds)) {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = kind;
      button.title = `Save this picture as ${kind}`;
      button.addEventListener("click", () => write(figure, name));
      tools.append(button);
    }
    caption.append(tools);
  }
})();
