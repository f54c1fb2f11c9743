"use strict";
// The pictures of a run as plots to zoom and point at. Without this script the pictures stay.
(function () {
  const run = JSON.parse(document.getElementById("run").textContent);
  const colors = { blue: "#0072B2", red: "#D55E00", sky: "#56B4E9", green: "#009E73", orange: "#E69F00" };
  const settings = { responsive: true, displaylogo: false };

  function look() {
    const style = getComputedStyle(document.documentElement);
    const of = (name) => style.getPropertyValue(name).trim();
    return { paper: of("--paper"), ink: of("--ink"), line: of("--line"), blue: of("--blue") };
  }

  function axis(theme, more) {
    return Object.assign({ gridcolor: theme.line, zerolinecolor: theme.line, linecolor: theme.line, automargin: true }, more);
  }

  function layout(theme, more) {
    return Object.assign({
      paper_bgcolor: theme.paper, plot_bgcolor: theme.paper, font: { color: theme.ink, size: 12 },
      margin: { l: 55, r: 15, t: 36, b: 45 }, legend: { orientation: "h", yref: "container", y: 0, yanchor: "bottom" },
    }, more);
  }

  function mapTraces(theme) {
    const told = run.poses.t.map((t, i) =>
      `${run.poses.told[i]} s, ${run.poses.mode[i]}<br>x ${run.poses.x[i]} m, y ${run.poses.y[i]} m, yaw ${run.poses.yaw_deg[i]}°` +
      (run.sigma ? `<br>σ ${run.sigma.position_mm[i]} mm, ${run.sigma.yaw_deg[i]}°` : ""));
    const traces = [];
    if (run.truth) traces.push({ name: "truth", x: run.truth.x, y: run.truth.y, mode: "lines", hoverinfo: "skip",
      line: { color: theme.ink, width: 5 }, opacity: 0.3 });
    const way = (values) => {
      const out = [];
      values.forEach((v, i) => { if (run.poses.breaks.includes(i)) out.push(null); out.push(v); });
      return out;
    };
    traces.push({ name: "estimate", x: way(run.poses.x), y: way(run.poses.y), mode: "lines+markers", text: way(told),
      hoverinfo: "text", line: { color: theme.blue, width: 1.5 },
      marker: { size: 4, color: way(run.poses.color.map((c) => c === colors.blue ? theme.blue : c)) } });
    run.edges.forEach((e, i) => traces.push({ name: "marker (id)", legendgroup: "m", showlegend: i === 0, x: e.x, y: e.y,
      mode: "lines", hoverinfo: "skip", line: { color: colors.red, width: 5 } }));
    if (run.landmarks.x.length) traces.push({ name: "landmark (id)", x: run.landmarks.x, y: run.landmarks.y,
      mode: "markers+text", text: run.landmarks.id, textposition: run.landmarks.label_at, hovertext: run.landmarks.told,
      hoverinfo: "text", showlegend: run.landmarks.shown.includes(1),
      marker: { color: colors.red, symbol: "diamond", size: 8, opacity: run.landmarks.shown } });
    traces.push({ name: "the time pointed at", x: [], y: [], mode: "markers", hoverinfo: "skip",
      marker: { color: colors.green, size: 13, symbol: "circle-open", line: { width: 3 } } });
    return traces;
  }

  function timeTraces(theme) {
    const traces = [];
    const rows = [["position_mm", "position", "y"], ["yaw_deg", "yaw", "y2"]];
    for (const [key, name, yaxis] of rows) {
      if (run.sigma) traces.push({ name: "3σ", showlegend: yaxis === "y", legendgroup: "s", x: run.poses.t, yaxis,
        y: run.sigma[key].map((s) => s === null ? null : +(3 * s).toPrecision(4)), mode: "lines", fill: "tozeroy",
        line: { color: colors.sky, width: 1 } });
      if (run.errors) traces.push({ name: "error against the truth", showlegend: yaxis === "y", legendgroup: "e",
        x: run.errors.t, y: run.errors[key], yaxis, mode: "lines", line: { color: theme.ink, width: 1.5 } });
    }
    for (const [key, name, color, symbol] of [["accepted", "sighting accepted", theme.blue, "circle"],
      ["rejected", "sighting rejected", colors.red, "x"]]) {
      const s = run.sightings[key];
      if (s.t.length) traces.push({ name, x: s.t, y: s.nis, text: s.told, yaxis: "y3", mode: "markers",
        hoverinfo: "text", marker: { color, symbol, size: 5 } });
    }
    return traces;
  }

  function draw() {
    const theme = look();
    const map = document.getElementById("map-plot");
    const time = document.getElementById("time-plot");
    map.hidden = time.hidden = false;
    const traces = mapTraces(theme);
    Plotly.react(map, traces, layout(theme, {
      height: Math.min(760, Math.max(420, 0.8 * map.clientWidth)), hovermode: "closest",
      xaxis: axis(theme, { title: { text: "x [m]" } }),
      yaxis: axis(theme, { title: { text: "y [m]" }, scaleanchor: "x", scaleratio: 1 }),
    }), settings);
    const shade = run.modes.map((m) => ({ type: "rect", xref: "x", yref: "paper", x0: m.start, x1: m.end, y0: 0, y1: 1,
      fillcolor: m.color, opacity: 0.18, line: { width: 0 }, layer: "below" }));
    const ticks = run.ticks ? { tickvals: run.ticks.at, ticktext: run.ticks.told } : {};
    const log = (values) => run.logarithmic ? { type: "log" } : { rangemode: "tozero" };
    const fit = run.sightings.accepted.t.length + run.sightings.rejected.t.length > 0;
    const rows = fit ? [[0.7, 1], [0.37, 0.65], [0, 0.3]] : [[0.54, 1], [0, 0.46]];
    const bottom = fit ? { yaxis3: axis(theme, { title: { text: "NIS / dof" }, domain: rows[2], type: "log" }) } : {};
    Plotly.react(time, timeTraces(theme), layout(theme, {
      height: fit ? 620 : 460, shapes: shade, hovermode: "x",
      xaxis: axis(theme, { title: { text: "time from the first pose [s]" }, anchor: fit ? "y3" : "y2", ...ticks }),
      yaxis: axis(theme, { title: { text: (run.errors ? "error, " : "") + "3σ [mm]" }, domain: rows[0], ...log() }),
      yaxis2: axis(theme, { title: { text: (run.errors ? "error, " : "") + "3σ [°]" }, domain: rows[1], ...log() }),
      ...bottom,
    }), settings);
    time.removeAllListeners("plotly_hover");
    time.on("plotly_hover", (event) => {
      const t = event.points[0].x;
      let k = 0;
      while (k + 1 < run.poses.t.length && run.poses.t[k + 1] <= t) k += 1;
      Plotly.restyle(map, { x: [[run.poses.x[k]]], y: [[run.poses.y[k]]] }, [traces.length - 1]);
    });
  }

  draw();
  for (const details of document.querySelectorAll("details.static")) details.open = false;
  window.addEventListener("beforeprint", () => {
    for (const details of document.querySelectorAll("details.static")) details.open = true;
  });
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
})();
