// The plots of the report: drawn from the JSON beside them, linked with each other, in the colours of the page.
"use strict";
(() => {
  const root = document.documentElement;
  if (typeof Plotly === "undefined") return;
  root.classList.add("scripted");

  const WORSE = [[0, "#2c7bb6"], [0.35, "#7fcdbb"], [0.65, "#fec44f"], [1, "#d7191c"]];
  const points = matchMedia("(hover: hover) and (pointer: fine)").matches;
  const CONFIG = {
    displaylogo: false, showTips: false, showSendToCloud: false, plotlyServerURL: "", displayModeBar: points ? "hover" : false,
    modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d", "toggleSpikelines"],
    toImageButtonOptions: { format: "svg" },
  };
  const figures = [...document.querySelectorAll("figure.plot")].map((box) => {
    const spec = JSON.parse(box.querySelector("script").textContent);
    const area = document.createElement("div");
    area.className = "area";
    box.append(area);
    return { box, area, spec, drawn: false };
  });
  const tracks = figures.find((figure) => figure.spec.beads);

  // --- colours and sizes -------------------------------------------------------------------------------------------

  let palette = null;
  const shade = (name) => palette.getPropertyValue(name).trim() || "#888";

  function themed(value) {
    if (typeof value === "string") return value.startsWith("--") ? shade(value) : value;
    if (Array.isArray(value)) return typeof value[0] === "object" && value[0] !== null ? value.map(themed) : value;
    if (value === null || typeof value !== "object") return value;
    return Object.fromEntries(Object.entries(value).map(([key, part]) => [key, themed(part)]));
  }

  function extent(data) {
    let low = [Infinity, Infinity], high = [-Infinity, -Infinity];
    for (const trace of data) {
      [trace.x, trace.y].forEach((values, k) => {
        for (const v of values) if (v !== null) { low[k] = Math.min(low[k], v); high[k] = Math.max(high[k], v); }
      });
    }
    return [Math.max(high[0] - low[0], 1), Math.max(high[1] - low[1], 1)];
  }

  function height(spec, width) {
    if (spec.height) return spec.height;
    if (spec.kind !== "plan") return (spec.layout.yaxis2 ? 310 : 240) + (width < 560 ? 20 : 0);
    const [wide, high] = extent(spec.data);
    return Math.round(Math.min(Math.max((width - 90) * high / wide, 180), 0.6 * width + 80, 560)) + 60;
  }

  function layout(figure) {
    const { spec } = figure;
    const width = figure.box.clientWidth;
    const small = width < 560;
    const own = themed(structuredClone(spec.layout));
    const common = { gridcolor: shade("--line"), linecolor: shade("--line"), tickcolor: shade("--line"), automargin: true };
    for (const name of Object.keys(own)) if (/^[xy]axis/.test(name)) own[name] = { ...common, ...own[name] };
    return {
      ...own, width, height: height(spec, width), autosize: false,
      margin: { l: small ? 46 : 58, r: small ? 8 : 16, t: 12, b: 44, ...own.margin },
      font: { family: "system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif", size: small ? 11 : 12, color: shade("--soft") },
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      hovermode: "closest", hoverdistance: spec.kind === "along" ? 200 : 25,
      hoverlabel: { bgcolor: shade("--card"), bordercolor: shade("--line"), font: { color: shade("--ink"), size: 12 }, align: "left" },
      dragmode: points ? "zoom" : false, showlegend: spec.kind !== "bars" && spec.data.some((trace) => trace.showlegend),
      legend: { orientation: "h", x: 0, y: 1.01, yanchor: "bottom", font: { size: small ? 11 : 12, color: shade("--ink") } },
      modebar: { bgcolor: "rgba(0,0,0,0)", color: shade("--quiet"), activecolor: shade("--accent") },
    };
  }

  // --- drawing -----------------------------------------------------------------------------------------------------

  function data(figure) {
    const traces = themed(structuredClone(figure.spec.data));
    for (const trace of traces) {
      if (trace.meta) for (const told of trace.customdata) told[1] += trace.meta.start_s;
    }
    return figure === tracks ? coloured(traces) : traces;
  }

  function draw(figure) {
    const full = layout(figure);
    if (figure === tracks) {
      full.images = background();
      full.xaxis.showgrid = full.yaxis.showgrid = full.images.length === 0;
    }
    if (figure.range) full.xaxis.range = figure.range;
    if (figure.drawn) { Plotly.react(figure.area, data(figure), full, CONFIG); return; }
    figure.drawn = true;
    Plotly.newPlot(figure.area, data(figure), full, CONFIG);
    figure.mark = document.createElement("i");
    figure.mark.className = figure.spec.kind === "plan" ? "here dot" : "here line";
    figure.area.append(figure.mark);
    figure.area.on("plotly_hover", (event) => pointed(figure, event.points[0]));
    figure.area.on("plotly_unhover", () => show(null));
    if (figure.spec.kind === "along") figure.area.on("plotly_relayout", () => zoomed(figure));
  }

  function redraw() {
    palette = getComputedStyle(root);
    for (const figure of figures) if (figure.drawn) draw(figure);
  }

  function drawAll() {
    palette = getComputedStyle(root);
    for (const figure of figures) if (!figure.drawn) draw(figure);
  }

  // --- the tracks: by what they are coloured, and on which picture --------------------------------------------------

  const colourChoice = document.querySelector("select.colours");
  const groundChoice = document.querySelector("select.ground");

  function coloured(traces) {
    const found = tracks.spec.colours.find((colour) => colour.key === (colourChoice ? colourChoice.value : ""));
    Object.entries(tracks.spec.beads).forEach(([session, number], k) => {
      const trace = traces[number];
      if (!found) return;
      const values = found.values[session] || trace.x.map(() => null);
      const scale = found.worse ? WORSE : "Viridis";
      trace.marker = {
        size: 6, color: values, cmin: found.low, cmax: found.high, colorscale: scale, showscale: k === 0,
        opacity: values.map((v) => (v === null ? 0 : 1)),
        colorbar: { thickness: 10, outlinewidth: 0, x: 1.01, xpad: 4, nticks: 6, ticksuffix: ` ${found.unit}`, exponentformat: "none" },
      };
      trace.text = values.map((v) => `${trace.name}<br>${found.label}: ${v === null ? "unknown" : `${v} ${found.unit}`}`);
    });
    return traces;
  }

  const hero = document.getElementById("map");
  const view = hero ? JSON.parse(hero.dataset.view) : null;

  function background() {
    const layer = groundChoice ? groundChoice.value : "";
    const image = layer && hero.querySelector(`img.${layer}`);
    if (!image) return [];
    return [{
      source: image.src, xref: "x", yref: "y", x: view.left_m, y: view.bottom_m + view.height * view.pixel_m,
      sizex: view.width * view.pixel_m, sizey: view.height * view.pixel_m, sizing: "stretch", layer: "below",
    }];
  }

  if (tracks && colourChoice) {
    for (const { key, label } of tracks.spec.colours) colourChoice.add(new Option(label, key));
    colourChoice.add(new Option(Object.keys(tracks.spec.beads).length > 1 ? "session" : "nothing", ""));
  }
  for (const choice of [colourChoice, groundChoice]) if (choice) choice.addEventListener("change", () => draw(tracks));

  // --- pointing at a place marks it everywhere ----------------------------------------------------------------------

  function pointed(figure, point) {
    if (figure === tracks && point.data.meta) show(point.data.meta.session, point.customdata[2]);
    else if (figure.spec.kind === "along") show(figure.spec.session, point.x);
  }

  function place(session, driven) {
    const trace = tracks && tracks.spec.data[tracks.spec.beads[session]];
    if (!trace) return null;
    let low = 0, high = trace.x.length - 1;
    while (high > low) {
      const middle = (low + high) >> 1;
      if (trace.customdata[middle][2] < driven) low = middle + 1; else high = middle;
    }
    const before = Math.max(low - 1, 0);
    const near = driven - trace.customdata[before][2] < trace.customdata[low][2] - driven ? before : low;
    return [trace.x[near], trace.y[near]];
  }

  const SVG = "http://www.w3.org/2000/svg";
  const overlay = hero && hero.querySelector("svg.overlay");
  const spot = overlay && overlay.appendChild(document.createElementNS(SVG, "circle"));
  if (spot) { spot.setAttribute("class", "here-spot"); spot.setAttribute("r", Math.max(view.width, view.height) / 90); }

  function show(session, driven) {
    const at = session === null ? null : place(session, driven);
    for (const figure of figures) {
      if (!figure.mark) continue;
      const { xaxis, yaxis, _size: size } = figure.area._fullLayout;
      const along = figure.spec.kind === "along" && figure.spec.session === session;
      const x = along ? xaxis.l2p(driven) : at && figure.spec.kind === "plan" ? xaxis.l2p(at[0]) : NaN;
      const inside = x >= 0 && x <= xaxis._length;
      figure.mark.style.display = inside ? "block" : "none";
      if (!inside) continue;
      figure.mark.style.left = `${xaxis._offset + x}px`;
      figure.mark.style.top = `${along ? size.t : yaxis._offset + yaxis.l2p(at[1])}px`;
      if (along) figure.mark.style.height = `${size.h}px`;
    }
    if (!spot) return;
    spot.style.display = at ? "block" : "none";
    if (!at) return;
    spot.setAttribute("cx", (at[0] - view.left_m) / view.pixel_m);
    spot.setAttribute("cy", view.height - (at[1] - view.bottom_m) / view.pixel_m);
  }

  // Plots along the way of one session show the same stretch of it; those that do already are left alone.
  function zoomed(figure) {
    const range = figure.area._fullLayout.xaxis.range.slice();
    for (const other of figures) {
      if (other.spec.kind !== "along" || other.spec.session !== figure.spec.session) continue;
      other.range = range;
      if (!other.drawn) continue;
      const shown = other.area._fullLayout.xaxis.range;
      if (shown[0] !== range[0] || shown[1] !== range[1]) Plotly.relayout(other.area, { "xaxis.range": range.slice() });
    }
  }

  // --- when: one plot after the other, at once for print, again when the page's colours or width change ---------------

  palette = getComputedStyle(root);
  const waiting = figures.slice();
  function next() {
    const figure = waiting.shift();
    if (!figure) { root.classList.add("drawn"); return; }
    if (!figure.drawn) draw(figure);
    setTimeout(next, 0);
  }
  next();

  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  let width = root.clientWidth;
  addEventListener("resize", () => {
    if (root.clientWidth === width || root.classList.contains("paper")) return;
    width = root.clientWidth;
    redraw();
  });
  addEventListener("beforeprint", () => { root.classList.add("paper"); drawAll(); redraw(); });
  addEventListener("afterprint", () => { root.classList.remove("paper"); redraw(); });
})();
