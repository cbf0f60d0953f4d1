"use strict";
(() => {
  const every = (what, where = document) => Array.from(where.querySelectorAll(what));
  const one = (what) => document.querySelector(what);

  // Sorting: numbers by data-value, text by its letters; what has no number stays last both ways.
  const keyOf = (row, column, numeric) => {
    const cell = row.cells[column];
    if (!numeric) return cell.textContent.trim().toLowerCase();
    return cell.dataset.value === undefined || cell.dataset.value === "" ? NaN : Number(cell.dataset.value);
  };
  const sortBy = (heading, rising) => {
    const table = heading.closest("table"), column = heading.cellIndex, numeric = heading.dataset.kind === "number";
    const keyed = Array.from(table.tBodies[0].rows, (row) => [keyOf(row, column, numeric), row]);
    keyed.sort(([a], [b]) => {
      if (!numeric) return (rising ? 1 : -1) * a.localeCompare(b);
      if (Number.isNaN(a) || Number.isNaN(b)) return Number.isNaN(a) - Number.isNaN(b);
      return (rising ? 1 : -1) * (a - b);
    });
    table.tBodies[0].append(...keyed.map(([, row]) => row));
    for (const each of every("th[aria-sort]", table)) each.setAttribute("aria-sort", "none");
    heading.setAttribute("aria-sort", rising ? "ascending" : "descending");
  };
  for (const heading of every("table.sortable thead th")) {
    heading.querySelector("button").addEventListener("click", () => {
      sortBy(heading, heading.getAttribute("aria-sort") !== "ascending");
    });
  }

  // Filters: a method is shown where all that it needs is at hand.
  const filter = () => {
    const absent = new Set(every("[data-need]").filter((box) => !box.checked).map((box) => box.dataset.need));
    const scene = one("#scene").value, oracles = one("#oracles");
    let shown = 0;
    for (const row of every("tbody tr[data-needs]")) {
      const lacks = row.dataset.needs.split(" ").some((need) => absent.has(need));
      const elsewhere = scene && row.dataset.scene && row.dataset.scene !== scene;
      row.hidden = lacks || elsewhere || Boolean(oracles && !oracles.checked && "oracle" in row.dataset);
      if (!row.hidden && row.dataset.scene) shown += 1;
    }
    for (const cell of every("#overview [data-scene]")) cell.hidden = Boolean(scene) && cell.dataset.scene !== scene;
    one("#shown").textContent = `${shown} of ${every("#entries tbody tr").length} lines`;
    mark();
  };

  // The best of each scene, oracles apart: bold, by the metric that is shown.
  const MORE_IS_BETTER = new Set(["completeness", "fscore_1px"]);
  const mark = () => {
    const sign = MORE_IS_BETTER.has(one("#metric").value) ? -1 : 1;
    for (const heading of every("#overview thead th[data-scene]")) {
      let best = null;
      for (const row of one("#overview").tBodies[0].rows) {
        const cell = row.cells[heading.cellIndex];
        cell.classList.remove("best");
        if (row.hidden || "oracle" in row.dataset || !cell.dataset.value) continue;
        if (best === null || sign * cell.dataset.value < sign * best.dataset.value) best = cell;
      }
      if (best !== null) best.classList.add("best");
    }
  };
  const said = (text) => (text ? Number(Number(text).toPrecision(3)).toString().replace("-", "\u2212") : "\u2013");
  const show = () => {
    const name = `data-${one("#metric").value.replaceAll("_", "-")}`;
    for (const cell of every("#overview td[data-median-um]")) {
      const text = cell.getAttribute(name);
      cell.dataset.value = text;
      cell.textContent = said(text);
    }
    for (const each of every("#overview th[aria-sort]")) each.setAttribute("aria-sort", "none");
    mark();
  };
  for (const box of every(".filters input, .filters select")) box.addEventListener("change", filter);
  one(".filters").addEventListener("submit", (event) => event.preventDefault());
  one("#metric").addEventListener("change", show);
  filter();

  // Plots: plotly travels compressed, and a plot is drawn when it comes into sight.
  const unpacked = async () => {
    const bytes = Uint8Array.from(atob(one("#plotly").textContent), (letter) => letter.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    const script = document.createElement("script");
    script.textContent = await new Response(stream).text();
    document.head.append(script);
  };
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const PLOT_PX = 260, AXIS_PX = 64;  // of a narrow page
  const layoutOf = (figure, narrow) => {
    const axis = { gridcolor: colour("--line"), zerolinecolor: colour("--line"), automargin: true, nticks: narrow ? 5 : 8 };
    const lines = figure.data.filter((each) => each.name && each.showlegend !== false).length;
    const names = narrow ? 19 * lines + 12 : 0;  // narrow pages have the names below the plot, one a line
    const below = { x: 0, y: -AXIS_PX / PLOT_PX, yanchor: "top", font: { size: 10 }, tracegroupgap: 0 };
    return {
      ...figure.layout,
      xaxis: { ...axis, ...figure.layout.xaxis }, yaxis: { ...axis, ...figure.layout.yaxis },
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", hovermode: "closest", dragmode: "zoom",
      font: { color: colour("--ink"), family: "system-ui, sans-serif", size: 12 },
      margin: narrow ? { l: 48, r: 8, t: 34, b: AXIS_PX + names } : { l: 60, r: 12, t: 34, b: 50 },
      ...(narrow ? { height: 34 + PLOT_PX + AXIS_PX + names } : {}),
      modebar: { bgcolor: "rgba(0,0,0,0)", color: colour("--quiet"), activecolor: colour("--accent") }, showlegend: lines > 0,
      legend: narrow ? below : { font: { size: 11 }, tracegroupgap: 0 },
    };
  };
  const FEW = "D2";  // 1, 2 and 5 of each power of ten
  const MANY = 1e4;  // over more than that, powers of ten alone are named
  const tall = (figure) => {
    const known = figure.data.flatMap((each) => each.y).filter((value) => value > 0);
    return Math.max(...known) > MANY * Math.min(...known);
  };
  const fewOf = (box, figure, name) => ((name === "xaxis" ? box.clientWidth < 700 : tall(figure)) ? 1 : FEW);
  const draw = (box) => {
    const figure = JSON.parse(one(`script[data-plot="${CSS.escape(box.id)}"]`).textContent);
    box.replaceChildren();
    const layout = layoutOf(figure, box.clientWidth < 700);
    box.style.height = layout.height ? `${layout.height}px` : "";
    const logarithmic = ["xaxis", "yaxis"].filter((name) => layout[name].type === "log");
    for (const name of logarithmic) layout[name].dtick = fewOf(box, figure, name);
    const options = { responsive: true, displaylogo: false, modeBarButtonsToRemove: ["select2d", "lasso2d", "sendChartToCloud"] };
    return Plotly.newPlot(box, figure.data, layout, options).then(() => {
      box.on("plotly_relayout", (changed) => {  // zoomed in, more places of an axis have to be named
        const named = {};
        for (const name of logarithmic) {
          if (`${name}.range[0]` in changed) named[`${name}.dtick`] = null;
          if (`${name}.autorange` in changed) named[`${name}.dtick`] = fewOf(box, figure, name);
        }
        if (Object.keys(named).length) Plotly.relayout(box, named);
      });
    });
  };
  const plots = every(".plot");
  if (plots.length) {
    unpacked().then(() => {
      const seen = new IntersectionObserver((entries) => {
        for (const entry of entries) {
          if (!entry.isIntersecting || entry.target.dataset.drawn) continue;
          entry.target.dataset.drawn = "yes";
          draw(entry.target);
        }
      }, { rootMargin: "400px" });
      for (const box of plots) seen.observe(box);
      dark.addEventListener("change", () => plots.filter((box) => box.dataset.drawn).forEach(draw));
      addEventListener("beforeprint", () => plots.filter((box) => !box.dataset.drawn).forEach(draw));
    });
  }
})();
