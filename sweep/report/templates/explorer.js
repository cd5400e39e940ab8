"use strict";
// The view of a grid, as lines or as a map: choose a quantity, the axes, and a value for each other axis; a range of an
// axis, brushed in the plot or typed, holds for every view of the grid and for its tables.
(() => {
  const MOST_SERIES = 14;
  const COLOURS = 7;
  const MARKERS = ["circle", "square", "diamond", "triangle", "inverted_triangle", "star", "x"];
  const [WIDE, EVEN] = [5, 0.01]; // WIDE_RATIO and EVEN of the figures

  // For a text with these signs BokehJS would load a library for formulae from the network.
  const plain = (text) => String(text).replaceAll("$$", "$\u200b$").replaceAll("\\(", "\\\u200b(").replaceAll("\\[", "\\\u200b[");
  const labelled = (thing) => (thing.unit ? `${thing.name} [${thing.unit}]` : thing.name);
  // A value of an axis, which has no effect where it is missing.
  const valued = (axis, i) => (axis.texts[i] === "" ? `no ${axis.name}` : `${axis.name} = ${axis.texts[i]}`);
  const textAt = (axis, i) => axis.texts[i] || "none";
  const numberAt = (axis, i) => (axis.texts[i] === "" ? NaN : Number(axis.texts[i]));
  // A number and its error with two digits of the error, as tables have them.
  const withError = (value, error, digits) => {
    if (!Number.isFinite(value)) return "";
    if (!(error > 0)) return shown(value, digits);
    const decimals = Math.max(0, 1 - Math.floor(Math.log10(error)));
    return decimals > 9 ? `${shown(value, digits)} ± ${Number(error.toPrecision(2))}` : `${value.toFixed(decimals)} ± ${error.toFixed(decimals)}`;
  };
  // How many digits tell numbers apart: six of their span; all of integers.
  const digitsOf = (values) => {
    const known = values.filter(Number.isFinite);
    const span = largest(known) - least(known);
    if (known.every(Number.isInteger)) return 17;
    return span > 0 ? Math.min(17, 6 + Math.max(0, Math.floor(Math.log10(largest(known.map(Math.abs)) / span)))) : 15;
  };
  const nan = (value) => Number(value ?? NaN);
  const shown = (value, digits) => (Number.isFinite(value) ? String(Number(value.toPrecision(digits))) : "");
  // Whether a number is in a range: itself, or as it is shown.
  const within = ([low, high], ...numbers) => numbers.some((value) => (low === null || value >= low) && (high === null || value <= high));
  const least = (values) => values.reduce((a, b) => (Number.isFinite(b) && b < a ? b : a), Infinity);
  const largest = (values) => values.reduce((a, b) => (Number.isFinite(b) && b > a ? b : a), -Infinity);
  const untouched = () => ({ quantity: 0, fixed: {}, x: "", series: "", scale: "", scaleX: "", kind: "", ranges: {} });
  const explorers = [];

  const colour = (element, name) => {
    const probe = document.createElement("span");
    probe.style.color = `var(--${name})`;
    element.append(probe);
    const found = getComputedStyle(probe).color;
    probe.remove();
    const parts = found.match(/[\d.]+/g).slice(0, 3).map(Number); // getComputedStyle gives rgb(r, g, b), Bokeh takes #rrggbb
    return `#${parts.map((part) => Math.round(part).toString(16).padStart(2, "0")).join("")}`;
  };

  // BokehJS keeps every document that it has shown.
  const forget = (view) => {
    const shownIn = view.model.document;
    shownIn.views_manager.clear();
    Bokeh.documents.splice(Bokeh.documents.indexOf(shownIn), 1);
  };

  // The range in which values that are all one are shown: of their size, since a great one is lost in one of 2.
  const aroundOne = (values) => Math.max(largest(values.map(Math.abs)), 0) / 5 || 2;
  // How far ascending places are at most from equal steps, as a share of their range.
  const unevenness = (places) => {
    const [first, last] = [places[0], places.at(-1)];
    return largest(places.map((place, i) => Math.abs((place - first) / (last - first) - i / (places.length - 1))));
  };

  // The rule of the figures: whatever is nearer to equal steps.
  const isLogarithmic = (values) => {
    const known = [...new Set(values.filter(Number.isFinite))].sort((a, b) => a - b);
    if (known.length < 3 || known[0] <= 0) return false;
    const [ofSteps, ofRatios] = [unevenness(known), unevenness(known.map(Math.log))];
    return ofRatios < ofSteps && (known.at(-1) > WIDE * known[0] || (ofRatios < EVEN && EVEN < 10 * ofSteps));
  };

  // Over less than two decades BokehJS labels a logarithmic axis as a linear one: 5, 10, 15, 20.
  const labelShort = (axis, grid, values) => {
    const known = values.filter((value) => value > 0);
    const [low, high] = [least(known), largest(known)].map(Math.log10);
    if (!(high - low < 2)) return;
    const powers = Array.from({ length: 4 }, (_, i) => Math.floor(low) - 1 + i);
    const ticks = (digits) => powers.flatMap((power) => digits.map((digit) => Number(`${digit}e${power}`)));
    axis.ticker = grid.ticker = new Bokeh.FixedTicker({ ticks: ticks([1, 2, 5]), minor_ticks: ticks([3, 4, 6, 7, 8, 9]) });
  };

  const named = (axis, grid, names) => {
    axis.ticker = grid.ticker = new Bokeh.FixedTicker({ ticks: [...names.keys()] });
    axis.major_label_overrides = new Map(names.entries());
    axis.major_label_policy = new Bokeh.NoOverlap();
  };

  // Where each value of an axis is in a map: between lower and upper edge; names are one apart.
  const cells = (axis, log) => {
    const [there, back] = log ? [Math.log, Math.exp] : [Number, Number];
    const known = axis.values.map((value, i) => [axis.numeric ? there(value) : i, i]).filter(([, i]) => axis.values[i] !== null);
    known.sort(([a], [b]) => a - b);
    const edges = known.slice(1).map(([at], k) => (at + known[k][0]) / 2);
    const half = (at, edge) => (edge === undefined ? 0.5 : Math.abs(edge - at));
    const [[first], [last]] = [known[0], known.at(-1)];
    const all = [first - half(first, edges[0]), ...edges, last + half(last, edges.at(-1))];
    const places = new Map(known.map(([at, i], k) => [i, [all[k], at, all[k + 1]].map(back)]));
    const whole = [all[0], (all[0] + all.at(-1)) / 2, all.at(-1)].map(back); // of points at which it has no effect
    return new Map(axis.values.map((_, i) => [i, places.get(i) ?? whole]));
  };

  const sourceOf = (columns, rows) =>
    new Bokeh.ColumnDataSource({ data: Object.fromEntries(Object.entries(columns).map(([name, make]) => [name, rows.map(make)])) });

  class Explorer {
    constructor(element) {
      this.element = element;
      this.data = JSON.parse(document.getElementById(element.dataset.explorer).textContent);
      this.choice = untouched();
      this.excluded = new Set(this.data.excluded.at);
      for (const one of this.data.quantities) one.digits = digitsOf(one.value);
      this.turn = 0;
      this.settle();
      this.first = JSON.stringify(this.choice);
      this.recall();
      if (JSON.stringify(this.choice) !== this.first) element.scrollIntoView();
      this.draw();
      window.addEventListener("popstate", () => {
        const before = JSON.stringify(this.choice);
        this.recall();
        if (JSON.stringify(this.choice) !== before) this.draw();
      });
      document.addEventListener("theme", () => this.draw());
      // BokehJS follows the width of the page later than it is printed: paper shows a picture of the plot.
      const plot = element.querySelector(".plot");
      window.addEventListener("beforeprint", () => this.view && plot.append(this.view.export().canvas));
      window.addEventListener("afterprint", () => plot.querySelector(":scope > canvas")?.remove());
    }

    // The choice is kept in the address, so that a view can be linked to, and gone back to.
    recall() {
      const hash = window.location.hash.slice(1);
      if (hash && !hash.includes("=")) return; // a place in the page: the view stays
      this.choice = JSON.parse(this.first);
      try {
        const found = JSON.parse(new URLSearchParams(hash).get(this.element.id));
        const quantity = this.data.quantities.findIndex((one) => one.name === found.quantity);
        const ranges = Object.entries(found.ranges ?? {}).filter(([name, range]) => this.axis(name)?.numeric && Array.isArray(range));
        if (quantity >= 0) this.choice = { ...untouched(), ...found, quantity, fixed: { ...found.fixed }, ranges: Object.fromEntries(ranges) };
      } catch { /* none, or an address that somebody has changed: the first view */ }
      this.settle();
    }

    remember() {
      const all = new URLSearchParams();
      for (const one of explorers) {
        const own = JSON.stringify({ ...one.choice, quantity: one.quantity.name }, (key, value) => (value === "" ? undefined : value));
        if (JSON.stringify(one.choice) !== one.first) all.set(one.element.id, own);
      }
      const address = String(all) ? `#${all}` : window.location.pathname + window.location.search;
      if (`#${all}` !== window.location.hash) window.history.pushState(null, "", address);
    }

    change(name) {
      this.settle();
      this.remember();
      this.draw();
      this.element.querySelector(`[name="${CSS.escape(name)}"]`)?.focus();
    }

    // Whether a place along a dimension is in the ranges that were chosen, but for those of some axes.
    inside(dim, i, ...except) {
      return Object.entries(this.choice.ranges).every(([name, range]) => {
        const axis = this.axis(name);
        return axis.dim !== dim || except.includes(name) || within(range, axis.values[i] ?? NaN, numberAt(axis, i));
      });
    }

    // The first view is at the middle of a numeric axis: at its end there may be nothing to see.
    index(dim) {
      const known = this.choice.fixed[dim];
      const axis = this.axis(dim);
      if (axis.values[known] !== undefined && this.inside(dim, known)) return known;
      const some = [...axis.values.keys()].filter((i) => this.inside(dim, i));
      return some[axis.numeric ? Math.floor(some.length / 2) : 0] ?? 0;
    }

    // The quantity with its component and the unit of this one, or with all units if several components are shown.
    labelOf(quantity) {
      if (!quantity.unit_dim) return labelled(quantity);
      const used = [this.choice.x, this.choice.series].filter(Boolean).map((name) => this.axis(name).dim);
      if (used.includes(quantity.unit_dim)) return labelled({ name: quantity.name, unit: [...new Set(quantity.units)].join(", ") });
      const i = this.index(quantity.unit_dim);
      return labelled({ name: `${quantity.name}(${this.axis(quantity.unit_dim).texts[i]})`, unit: quantity.units[i] });
    }

    get quantity() { return this.data.quantities[this.choice.quantity]; }

    axesOf(dims) { return this.data.axes.filter((axis) => dims.includes(axis.dim)); }

    axis(name) { return this.data.axes.find((axis) => axis.name === name); }

    size(dim) { return this.axis(dim).values.length; }

    // Restrict the choice to the axes of this quantity, with the longest numeric one along x.
    settle() {
      const { choice } = this;
      const axes = this.axesOf(this.quantity.dims);
      if (!axes.some((axis) => axis.name === choice.x)) {
        const numeric = axes.filter((axis) => axis.numeric && axis.values.length > 1);
        choice.x = (numeric.length ? numeric : axes).toSorted((a, b) => b.values.length - a.values.length)[0]?.name ?? "";
      }
      const others = this.others();
      if (!others.length) choice.kind = "";
      if (others.some((axis) => axis.name === choice.series)) return;
      const apart = others.filter((axis) => axis.dim !== this.axis(choice.x).dim);
      const few = apart.filter((axis) => axis.name === axis.dim && axis.values.length > 1 && axis.values.length <= MOST_SERIES && axis.name !== this.quantity.unit_dim);
      const [other] = choice.kind === "map" ? [...apart, ...others] : choice.noSeries ? [] : few;
      choice.series = other?.name ?? "";
    }

    // The axes of numbers that the plot shows: along x, and in a map along y.
    numeric() {
      return [this.choice.x, ...(this.choice.kind === "map" ? [this.choice.series] : [])].map((name) => this.axis(name)).filter((axis) => axis?.numeric);
    }

    // What may be along y of a map, or the series of lines: points of a table have no series, and are a map as dots.
    others() {
      const x = this.axis(this.choice.x) ?? {};
      const isMap = this.choice.kind === "map";
      return this.axesOf(this.quantity.dims).filter((axis) => axis.name !== x.name && (axis.dim !== x.dim || (isMap && axis.numeric)));
    }

    control(element, name, label, change) {
      const box = document.createElement("label");
      box.append(label, element);
      element.name = name;
      element.addEventListener("change", () => {
        change(element.value);
        setTimeout(() => this.change(document.activeElement?.name || name)); // the next control has the focus by then
      });
      return box;
    }

    // Both ends of the range of an axis; an empty one is open.
    ends(axis) {
      const range = this.choice.ranges[axis.name] ?? [null, null];
      const known = [...axis.texts.keys()].map((i) => numberAt(axis, i));
      return ["from", "to"].map((word, end) => {
        const input = document.createElement("input");
        Object.assign(input, { type: "number", step: "any", ariaLabel: `${labelled(axis)} ${word}`, placeholder: end ? largest(known) : least(known), value: range[end] ?? "" });
        return this.control(input, `${word}-${axis.name}`, end ? "to" : `${labelled(axis)} from`, (value) => {
          this.choice.ranges[axis.name] = range.with(end, value === "" ? null : Number(value));
          if (this.choice.ranges[axis.name].every((one) => one === null)) delete this.choice.ranges[axis.name];
        });
      });
    }

    select(name, label, options, current, change) {
      const select = document.createElement("select");
      select.append(...options.map(([value, text]) => new Option(text, value, false, String(value) === String(current))));
      return this.control(select, name, label, change);
    }

    controls() {
      const { choice, quantity } = this;
      const axes = this.axesOf(quantity.dims);
      const boxes = [
        this.select("quantity", "Quantity", this.data.quantities.map((one, i) => [i, one.unit_dim ? one.name : labelled(one)]), choice.quantity, (v) => { choice.quantity = Number(v); }),
      ];
      const scales = [["", "automatic"], ["linear", "linear"], ["log", "logarithmic"]];
      const isMap = choice.kind === "map";
      if (axes.length > 1) boxes.push(this.select("kind", "Show as", [["", "lines"], ["map", "map"]], choice.kind, (v) => { choice.kind = v; }));
      if (axes.length) {
        const x = this.axis(choice.x);
        boxes.push(this.select("x", "Along x", axes.map((axis) => [axis.name, labelled(axis)]), choice.x, (v) => { choice.x = v; }));
        const others = this.others().map((axis) => [axis.name, labelled(axis)]);
        if (others.length) {
          const options = isMap ? others : [["", "none"], ...others];
          boxes.push(this.select("series", isMap ? "Along y" : "Series", options, choice.series, (v) => { choice.series = v; choice.noSeries = v === ""; }));
        }
        for (const dim of this.fixedDims()) {
          const axis = this.axis(dim);
          const options = axis.texts.map((_, i) => [i, textAt(axis, i)]).filter(([i]) => this.inside(dim, i));
          boxes.push(this.select(`fixed-${dim}`, `${labelled(axis)} =`, options, this.index(dim), (v) => { choice.fixed[dim] = Number(v); }));
        }
        if (x.numeric && least(x.values) > 0) boxes.push(this.select("scaleX", "Scale of x", scales, choice.scaleX, (v) => { choice.scaleX = v; }));
        boxes.push(this.select("scale", isMap ? "Scale of colours" : "Scale of y", scales, choice.scale, (v) => { choice.scale = v; }));
        for (const axis of this.numeric()) boxes.push(...this.ends(axis));
      }
      if (Object.keys(choice.ranges).length) {
        const all = document.createElement("button");
        Object.assign(all, { type: "button", name: "all", textContent: "All points" });
        all.addEventListener("click", () => { choice.ranges = {}; this.change("x"); });
        boxes.push(all);
      }
      this.element.querySelector(".controls").replaceChildren(...boxes);
    }

    // What is known at a place along the dimensions, the other ones at the values chosen.
    at(places) {
      const flat = (dims) => dims.reduce((sum, dim) => sum * this.size(dim) + (places[dim] ?? this.fixed[dim]), 0);
      const at = flat(this.quantity.dims);
      const part = (name) => nan(this.quantity[name]?.[at]);
      const exact = this.quantity.value[at]; // a text of an integer that JavaScript has no number for, or inf
      const excluded = this.excluded.has(flat(this.data.excluded.dims));
      return { value: part("value"), error: part("error"), predicted: part("predicted"), published: part("published"), exact, excluded };
    }

    fixedDims() {
      const used = [this.choice.x, this.choice.series].filter(Boolean).map((name) => this.axis(name).dim);
      return this.quantity.dims.filter((dim) => !used.includes(dim));
    }

    // The numbers of one series, or of one row of a map, in the order of x; of a table of points a map has one row.
    columns(number) {
      const [x, other] = [this.choice.x, this.choice.series].map((name) => this.axis(name) ?? { values: [""], texts: [""] });
      const alone = other.dim === x.dim;
      const rows = [];
      x.values.forEach((place, i) => {
        if (!this.inside(x.dim, i, ...this.shown)) return;
        const j = alone ? i : number;
        const alpha = this.inside(x.dim, i) && this.inside(other.dim, j) ? 1 : 0.15;
        const row = { x: place, i, j, alpha, place: textAt(x, i), ...this.at({ [other.dim]: j, [x.dim]: i }) };
        if (!row.excluded || !this.data.excluded.refined) rows.push(row); // other series have points in between
      });
      return x.numeric ? rows.sort((a, b) => a.x - b.x) : rows;
    }

    async draw() {
      this.turn += 1;
      const turn = this.turn;
      this.controls();
      const { choice, quantity } = this;
      const isMap = choice.kind === "map";
      const x = choice.x ? this.axis(choice.x) : null;
      const series = choice.series ? this.axis(choice.series) : null; // in a map that along y
      this.fixed = Object.fromEntries(quantity.dims.map((dim) => [dim, this.index(dim)]));
      this.shown = isMap ? [x.name, series.name] : [choice.x];
      const apart = series && series.dim !== x.dim;
      const numbers = apart ? [...series.values.keys()].filter((i) => this.inside(series.dim, i, ...this.shown)) : [0];
      const drawn = isMap ? numbers : numbers.slice(0, MOST_SERIES);
      const numeric = x !== null && x.numeric;
      const factors = x && !numeric ? this.factors(x) : [""];
      const everything = drawn.map((number) => this.columns(number));
      const flat = everything.flat();
      const scale = choice.scale || quantity.scale || (isLogarithmic(flat.map((row) => row.value)) && !quantity.unit.match(/^(mag|dB|dex)$/) ? "log" : "linear");
      const logValue = scale === "log" && flat.every((row) => !(row.value <= 0));
      const logX = numeric && least(x.values) > 0 && (choice.scaleX ? choice.scaleX === "log" : x.logarithmic);
      const logY = isMap ? series.logarithmic : logValue;
      const [ink, line, page] = ["ink", "line", "page"].map((name) => colour(this.element, name));
      const figure = Bokeh.Plotting.figure({
        height: 416,
        sizing_mode: "stretch_width",
        tools: "pan,box_zoom,wheel_zoom,reset,save",
        x_axis_type: numeric || isMap ? (logX ? "log" : "linear") : "auto",
        y_axis_type: logY ? "log" : "linear",
        ...(numeric || isMap ? {} : { x_range: new Bokeh.FactorRange({ factors }) }),
        x_axis_label: plain(x ? labelled(x) : ""),
        y_axis_label: plain(isMap ? labelled(series) : this.labelOf(quantity)),
        background_fill_color: page, // a transparent figure shows what was painted before its last layout
        border_fill_color: page,
        outline_line_color: line,
      });
      if (numeric && !isMap && !logX) figure.x_range.default_span = aroundOne(x.values);
      if (!isMap && !logY) figure.y_range.default_span = aroundOne(flat.map((row) => row.value));
      figure.toolbar.logo = null;
      figure.toolbar.active_scroll = null;
      const along = { x: [[...figure.xaxis][0], [...figure.xgrid][0]], y: [[...figure.yaxis][0], [...figure.ygrid][0]] };
      if (quantity.truth && !isMap) named(...along.y, ["False", "True"]);
      if (isMap && !numeric) named(...along.x, factors);
      // A letter is some 6 pixels wide; what would not fit side by side is turned, and what would not fit then is left out.
      if (!numeric && factors.length * largest(factors.map((one) => one.length)) * 6 > this.element.clientWidth - 100) Object.assign(along.x[0], { major_label_orientation: Math.PI / 4, major_label_policy: new Bokeh.NoOverlap() });
      if (isMap && !series.numeric) named(...along.y, this.factors(series));
      if (logX) labelShort(...along.x, x.values);
      if (logY) labelShort(...along.y, isMap ? series.values : flat.map((row) => row.value));
      this.dress(figure, ink, line);
      this.brush(figure);
      if (isMap) this.map(figure, flat, x, series, { logX, logY, logValue, ink });
      else this.lines(figure, everything, x, series, { drawn, numeric, factors, logY, ink });
      const target = document.createElement("div");
      const view = await Bokeh.Plotting.show(figure, target);
      if (turn !== this.turn) { // a later choice was drawn meanwhile
        forget(view);
        return;
      }
      Object.assign(target, { role: "figure", ariaLabel: [this.labelOf(quantity), [x, series].filter(Boolean).map(labelled).join(" and ")].filter(Boolean).join(" over ") });
      this.element.querySelector(".plot").replaceChildren(target);
      if (this.view) forget(this.view);
      this.view = view;
      this.note(flat, numbers.length, drawn.length, logValue);
      this.filter();
      this.element.dataset.drawn = this.isDark() ? "dark" : "light";
      this.element.dataset.turn = String(turn);
    }

    lines(figure, everything, x, series, { drawn, numeric, factors, logY, ink }) {
      const { quantity } = this;
      const legend = [];
      const kinds = [];
      everything.forEach((rows, k) => {
        const number = drawn[k];
        const name = series ? textAt(series, number) : quantity.name;
        kinds.push(this.series(figure, rows, { name, number, numeric, joined: numeric && x.ordered && !quantity.truth, factors, logY }));
        const renderers = Object.values(kinds[k]).flat();
        if (renderers.length) legend.push(new Bokeh.LegendItem({ label: plain(series ? valued(series, number) : name), renderers }));
      });
      for (const [part, text] of [["predicted", "predicted"], ["published", "published"], ["error", "one-sigma error"]]) {
        const renderers = kinds.flatMap((one) => one[part]);
        if (renderers.length) legend.push(new Bokeh.LegendItem({ label: text, renderers: [this.sign(figure, part, renderers, ink, x, factors)] }));
      }
      this.hover(figure, kinds.flatMap((one) => one.value), x);
      if (legend.length > 1 || quantity.predicted || quantity.published) {
        const box = new Bokeh.Legend({ items: legend, click_policy: "hide", orientation: "horizontal", location: "left", ncols: this.element.clientWidth < 500 ? 1 : 4, background_fill_alpha: 0, border_line_alpha: 0, label_text_color: ink, label_text_font_size: "12px", inactive_fill_alpha: 0.5 });
        figure.add_layout(box, "below");
      }
    }

    // Cells of a grid, or dots of a table of points, in colours of the quantity.
    map(figure, rows, x, y, { logX, logY, logValue, ink }) {
      const [alongX, alongY] = [cells(x, logX), cells(y, logY)];
      const isDots = x.dim === y.dim;
      const known = rows.filter((row) => Number.isFinite(row.value) && !(isDots && (x.values[row.i] === null || y.values[row.j] === null)));
      const columns = { ...this.texts(), number: (row) => row.value, place: (row) => row.place, name: (row) => textAt(y, row.j) };
      ["left", "x", "right"].forEach((name, k) => { columns[name] = (row) => alongX.get(row.i)[k]; });
      ["bottom", "y", "top"].forEach((name, k) => { columns[name] = (row) => alongY.get(row.j)[k]; });
      const source = sourceOf(columns, known);
      const { truth } = this.quantity;
      const [low, high] = truth ? [-0.5, 1.5] : [least(source.data.number), largest(source.data.number)];
      const palette = Bokeh.Palettes.Cividis256.filter((_, k) => !truth || k % 255 === 0);
      const mapper = new Bokeh[logValue ? "LogColorMapper" : "LinearColorMapper"]({ palette, low, high });
      const look = { source, fill_color: { field: "number", transform: mapper }, fill_alpha: { field: "alpha" }, line_color: null };
      const [left, right, bottom, top, atX, atY] = ["left", "right", "bottom", "top", "x", "y"].map((field) => ({ field }));
      const drawn = isDots ? figure.scatter(atX, atY, { ...look, size: 9 }) : figure.quad(left, right, bottom, top, look);
      this.hover(figure, [drawn], x);
      const place = this.element.clientWidth < 500 ? "below" : "right";
      const text = { title_text_color: ink, major_label_text_color: ink, title_text_font_style: "normal", background_fill_alpha: 0 };
      const bar = new Bokeh.ColorBar({ color_mapper: mapper, title: plain(this.labelOf(this.quantity)), ...text });
      if (truth) named(bar, bar, ["False", "True"]);
      figure.add_layout(bar, place);
    }

    // Dragging in the plot chooses the range of the values under it, on every axis of numbers that it shows.
    brush(figure) {
      const axes = this.numeric();
      const along = (axis) => (axis.name === this.choice.x ? "x" : "y");
      if (!axes.length) return;
      const tool = new Bokeh.BoxSelectTool({ dimensions: axes.length > 1 ? "both" : along(axes[0]) === "x" ? "width" : "height", description: "Choose a range" });
      figure.add_tools(tool);
      figure.toolbar.active_drag = tool;
      figure.on_event("selectiongeometry", ({ geometry, final }) => {
        if (!final) return;
        for (const axis of axes) {
          const range = [geometry[`${along(axis)}0`], geometry[`${along(axis)}1`]];
          const under = [...axis.texts.keys()].map((i) => numberAt(axis, i)).filter((value) => within(range, value));
          if (under.length) this.choice.ranges[axis.name] = [least(under), largest(under)];
        }
        this.change("all");
      });
    }

    // The tables beside the view show what is inside, too.
    filter() {
      for (const table of this.element.parentElement.querySelectorAll("table.sortable")) {
        const heads = [...table.tHead.rows[0].cells].map((cell) => cell.textContent);
        const tests = Object.entries(this.choice.ranges).map(([name, range]) => [heads.indexOf(labelled(this.axis(name))), range]).filter(([column]) => column >= 0);
        const rows = [...table.tBodies[0].rows];
        const numbers = (cell) => [cell.dataset.value ?? NaN, cell.textContent || NaN].map(Number);
        for (const row of rows) row.hidden = !tests.every(([column, range]) => within(range, ...numbers(row.cells[column])));
        const kept = rows.filter((row) => !row.hidden).length;
        table.caption.dataset.brushed = tests.length ? `${this.inWords()}: ${kept} of ${rows.length} rows. ` : "";
      }
    }

    inWords() {
      const texts = Object.entries(this.choice.ranges).map(([name, [low, high]]) => `${name} ${low === null ? "" : `from ${low} `}${high === null ? "" : `to ${high}`}`.trim());
      return texts.length ? `Only ${texts.join(", ")}` : "";
    }

    isDark() {
      const set = document.documentElement.dataset.theme;
      return set ? set === "dark" : window.matchMedia("(prefers-color-scheme: dark)").matches;
    }

    // A name that occurs twice along an axis gets its position as a number.
    factors(axis) {
      const names = axis.texts.map((_, i) => plain(textAt(axis, i)));
      const first = new Map(names.map((name, i) => [name, i]).reverse());
      return names.map((name, i) => (first.get(name) === i ? name : `${name} (${i + 1})`));
    }

    dress(figure, ink, line) {
      for (const axis of [...figure.xaxis, ...figure.yaxis]) {
        axis.axis_label_text_color = ink;
        axis.axis_label_text_font_style = "normal";
        axis.major_label_text_color = ink;
        for (const part of ["axis_line_color", "major_tick_line_color", "minor_tick_line_color"]) axis[part] = line;
      }
      for (const grid of [...figure.xgrid, ...figure.ygrid]) {
        grid.grid_line_color = line;
        grid.grid_line_alpha = 0.6;
      }
    }

    series(figure, rows, { name, number, numeric, joined, factors, logY }) {
      const tint = colour(this.element, `series-${number % COLOURS}`);
      const marker = MARKERS[(number + Math.floor(number / COLOURS)) % MARKERS.length];
      const place = (row) => (numeric ? row.x : factors[row.i]);
      const lowest = (centre, half) => (logY && centre - half <= 0 ? centre / 10 : centre - half);
      const columns = {
        ...this.texts(),
        x: place,
        name: () => name,
        place: (row) => row.place,
        low: (row) => lowest(row.value, row.error > 0 ? row.error : 0),
        high: (row) => row.value + (row.error > 0 ? row.error : 0),
      };
      const kinds = { line: [], predicted: [], error: [], value: [], published: [] };
      const there = rows.filter((row) => row.x !== null);
      const heights = there.map((row) => (logY && row.value <= 0 ? NaN : row.value));
      if (joined && heights.filter(Number.isFinite).length > 1) {
        kinds.line.push(figure.line(there.map(place), heights, { line_color: tint, line_width: 1, line_alpha: 0.55 }));
      }
      const put = (kind, part, draw, style, some = there) => {
        const kept = some.filter((row) => Number.isFinite(row[part]) && !(logY && row[part] <= 0));
        const source = sourceOf({ ...columns, y: (row) => row[part] }, kept);
        if (kept.length) kinds[kind].push(draw({ source, line_color: tint, line_alpha: { field: "alpha" }, ...style }));
      };
      const [atX, atY, low, high] = ["x", "y", "low", "high"].map((field) => ({ field }));
      const axis = this.axis(this.choice.x);
      const mark = (style) => figure.scatter(atX, atY, style);
      put("predicted", "predicted", mark, { marker: "dash", size: 22, line_width: 2 }); // known at the points alone
      if (this.quantity.error) put("error", "value", (style) => figure.segment(atX, low, atX, high, style), { line_width: 1.5 });
      put("value", "value", mark, { marker, size: 7, fill_color: tint, fill_alpha: { field: "alpha" } });
      const level = (style) => figure.segment({ value: least(axis.values) }, atY, { value: largest(axis.values) }, atY, style);
      put("value", "value", level, { line_dash: "dotted", line_width: 1.5 }, rows.filter((row) => row.x === null)); // x has no effect
      put("published", "published", mark, { marker, size: 14, fill_alpha: 0, line_width: 1.5 });
      return kinds;
    }

    // One sign in the legend for what all series have: theirs would be drawn over one another.  It is drawn nowhere else.
    sign(figure, part, renderers, ink, axis, factors) {
      const place = [axis && axis.numeric ? axis.values.find((value) => value !== null && value > 0) ?? 0 : factors[0]];
      const styles = {
        predicted: { marker: "dash", size: 22, line_width: 2 },
        published: { marker: "circle", size: 14, fill_alpha: 0, line_width: 1.5 },
        error: { marker: "cross", size: 14, line_width: 1.5 },
      };
      const one = figure.scatter(place, [NaN], { line_color: ink, ...styles[part] });
      one.properties.visible.change.connect(() => { for (const other of renderers) other.visible = one.visible; });
      return one;
    }

    // What the source of a plot has for every row beside its place.
    texts() {
      const { digits } = this.quantity;
      return {
        alpha: (row) => row.alpha,
        value: (row) => (this.quantity.truth ? ["False", "True"][row.value] : typeof row.exact === "string" ? row.exact : withError(row.value, row.error, digits)),
        predicted: (row) => shown(row.predicted, digits),
        published: (row) => shown(row.published, digits),
      };
    }

    hover(figure, renderers, x) {
      const rows = [[this.choice.series || "quantity", "@name"]];
      if (x) rows.push([labelled(x), "@place"]);
      rows.push([this.labelOf(this.quantity), "@value"]);
      for (const part of ["predicted", "published"]) if (this.quantity[part]) rows.push([part, `@${part}`]);
      figure.add_tools(new Bokeh.HoverTool({ renderers, tooltips: rows.map(([name, value]) => [plain(name).replaceAll("@", "＠").replaceAll("$", "＄"), value]) }));
    }

    note(flat, total, drawn, logValue) {
      const { choice, quantity } = this;
      const fixed = this.fixedDims().filter((dim) => this.size(dim) > 1).map((dim) => valued(this.axis(dim), this.fixed[dim]));
      const asked = flat.filter((row) => !row.excluded);
      const infinite = asked.filter((row) => /inf/.test(row.exact)).length;
      const gone = asked.filter((row) => !Number.isFinite(row.value)).length - infinite;
      const isMap = choice.kind === "map";
      const sentences = [
        fixed.length && `At ${fixed.join(", ")}.`,
        this.inWords() && `${this.inWords()}.`,
        quantity.meaning && `${quantity.name}: ${quantity.meaning}.`,
        !isMap && quantity.error && "Bars are one-sigma errors.",
        !isMap && quantity.predicted && "Dashes are predicted.",
        !isMap && quantity.published && "Published values are large open symbols.",
        drawn < total && `The first ${drawn} of ${total} series are drawn; exchange x and series, or show a map, to see all.`,
        infinite && `${infinite} of ${asked.length} values are infinite and not drawn.`,
        gone && `${gone} of ${asked.length} values are missing and not drawn.`,
        (choice.scale || quantity.scale) === "log" && !logValue && "There are values that are not above zero: the scale stays linear.",
      ].filter(Boolean);
      this.element.querySelector(".status").textContent = sentences.join(" ");
    }
  }

  for (const element of document.querySelectorAll("[data-explorer]")) explorers.push(new Explorer(element));
})();
