"use strict";
// The view of a grid: choose a quantity, the axis along x, the axis of the series, and a value for each other axis.
(() => {
  const MOST_SERIES = 14;
  const COLOURS = 7;
  const MARKERS = ["circle", "square", "diamond", "triangle", "inverted_triangle", "star", "x"];
  const [WIDE, EVEN] = [5, 0.01]; // WIDE_RATIO and EVEN of the figures

  // For a text with these signs BokehJS would load a library for formulae from the network.
  const plain = (text) => String(text).replaceAll("$$", "$\u200b$").replaceAll("\\(", "\\\u200b(").replaceAll("\\[", "\\\u200b[");
  const labelled = (thing) => (thing.unit ? `${thing.name} [${thing.unit}]` : thing.name);
  // A number and its error with two digits of the error, as tables have them.
  const withError = (value, error) => {
    if (!Number.isFinite(value)) return "";
    if (!(error > 0)) return shown(value);
    const decimals = Math.max(0, 1 - Math.floor(Math.log10(error)));
    return decimals > 9 ? `${shown(value)} ± ${Number(error.toPrecision(2))}` : `${value.toFixed(decimals)} ± ${error.toFixed(decimals)}`;
  };
  const nan = (value) => (value === null || value === undefined ? NaN : value);
  const shown = (value) => (Number.isFinite(value) ? String(Number(value.toPrecision(6))) : "");

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

  // How far ascending places are at most from equal steps, as a share of their range.
  const unevenness = (places) => {
    const [first, last] = [places[0], places.at(-1)];
    return Math.max(...places.map((place, i) => Math.abs((place - first) / (last - first) - i / (places.length - 1))));
  };

  // The rule of the figures: whatever is nearer to equal steps.
  const isLogarithmic = (values) => {
    const known = [...new Set(values.filter(Number.isFinite))].sort((a, b) => a - b);
    if (known.length < 3 || known[0] <= 0) return false;
    const ofRatios = unevenness(known.map(Math.log));
    return ofRatios < unevenness(known) && (ofRatios < EVEN || known.at(-1) > WIDE * known[0]);
  };

  // Over less than two decades BokehJS labels a logarithmic axis as a linear one: 5, 10, 15, 20.
  const labelShort = (axis, grid, values) => {
    const known = values.filter((value) => value > 0);
    const [low, high] = [Math.min(...known), Math.max(...known)].map(Math.log10);
    if (!(high - low < 2)) return;
    const powers = Array.from({ length: 4 }, (_, i) => Math.floor(low) - 1 + i);
    const ticks = (digits) => powers.flatMap((power) => digits.map((digit) => Number(`${digit}e${power}`)));
    axis.ticker = grid.ticker = new Bokeh.FixedTicker({ ticks: ticks([1, 2, 5]), minor_ticks: ticks([3, 4, 6, 7, 8, 9]) });
  };

  class Explorer {
    constructor(element) {
      this.element = element;
      this.data = JSON.parse(document.getElementById(element.dataset.explorer).textContent);
      this.choice = { quantity: 0, fixed: {}, x: "", series: "", scale: "" };
      this.turn = 0;
      this.recall();
      this.settle();
      this.draw();
      document.addEventListener("theme", () => this.draw());
      window.addEventListener("beforeprint", () => this.showTools(false));
      window.addEventListener("afterprint", () => this.showTools(true));
    }

    // The choice is kept in the address, so that a view can be linked to.
    recall() {
      const own = new URLSearchParams(window.location.hash.slice(1)).get(this.element.id);
      if (!own) return;
      try {
        const found = JSON.parse(own);
        const quantity = this.data.quantities.findIndex((one) => one.name === found.quantity);
        if (quantity >= 0) this.choice = { ...this.choice, ...found, quantity, fixed: { ...found.fixed } };
      } catch { /* an address that somebody has changed: the first view */ }
    }

    remember() {
      const all = new URLSearchParams(window.location.hash.includes("=") ? window.location.hash.slice(1) : "");
      all.set(this.element.id, JSON.stringify({ ...this.choice, quantity: this.quantity.name }));
      window.history.replaceState(null, "", `#${all}`);
    }

    // The first view is at the middle of a numeric axis: at its end there may be nothing to see.
    index(dim) {
      const known = this.choice.fixed[dim];
      if (known !== undefined && known < this.size(dim)) return known;
      const axis = this.axis(dim);
      return axis.numeric ? Math.floor(axis.values.length / 2) : 0;
    }

    // The quantity with its component and the unit of this one, or with all units if several components are shown.
    labelOf(quantity) {
      if (!quantity.unit_dim) return labelled(quantity);
      const used = [this.choice.x, this.choice.series].filter(Boolean).map((name) => this.axis(name).dim);
      if (used.includes(quantity.unit_dim)) return labelled({ name: quantity.name, unit: [...new Set(quantity.units)].join(", ") });
      const i = this.index(quantity.unit_dim);
      return labelled({ name: `${quantity.name}(${this.axis(quantity.unit_dim).values[i]})`, unit: quantity.units[i] });
    }

    get quantity() { return this.data.quantities[this.choice.quantity]; }

    axesOf(dims) { return this.data.axes.filter((axis) => dims.includes(axis.dim)); }

    axis(name) { return this.data.axes.find((axis) => axis.name === name); }

    size(dim) { return this.axis(dim).values.length; }

    // Restrict the choice to the axes of this quantity, with the longest numeric one along x.
    settle() {
      const axes = this.axesOf(this.quantity.dims);
      const known = (name) => axes.some((axis) => axis.name === name);
      if (!known(this.choice.x)) {
        const candidates = axes.filter((axis) => axis.numeric && axis.values.length > 1);
        const longest = (candidates.length ? candidates : axes).slice().sort((a, b) => b.values.length - a.values.length);
        this.choice.x = longest.length ? longest[0].name : "";
      }
      const dim = this.choice.x ? this.axis(this.choice.x).dim : "";
      if (this.choice.series && (!known(this.choice.series) || this.axis(this.choice.series).dim === dim)) this.choice.series = "";
      if (!this.choice.series && !this.choice.noSeries) {
        const other = axes.find((axis) => axis.name === axis.dim && axis.dim !== dim && axis.values.length > 1 && axis.values.length <= MOST_SERIES && axis.name !== this.quantity.unit_dim);
        this.choice.series = other ? other.name : "";
      }
    }

    select(name, label, options, current, change) {
      const box = document.createElement("label");
      box.append(label);
      const select = document.createElement("select");
      select.name = name;
      for (const [value, text] of options) {
        const option = document.createElement("option");
        option.value = value;
        option.textContent = text;
        option.selected = String(value) === String(current);
        select.append(option);
      }
      select.addEventListener("change", () => {
        change(select.value);
        this.settle();
        this.remember();
        this.draw();
        const again = [...this.element.querySelectorAll("select")].find((other) => other.name === name);
        if (again) again.focus();
      });
      box.append(select);
      return box;
    }

    controls() {
      const { choice, quantity } = this;
      const axes = this.axesOf(quantity.dims);
      const boxes = [
        this.select("quantity", "Quantity", this.data.quantities.map((one, i) => [i, one.unit_dim ? one.name : labelled(one)]), choice.quantity, (v) => { choice.quantity = Number(v); }),
      ];
      if (axes.length) {
        boxes.push(this.select("x", "Along x", axes.map((axis) => [axis.name, labelled(axis)]), choice.x, (v) => { choice.x = v; }));
        const along = this.axis(choice.x).dim;
        const others = axes.filter((axis) => axis.dim !== along);
        if (others.length) {
          const options = [["", "none"], ...others.map((axis) => [axis.name, labelled(axis)])];
          boxes.push(this.select("series", "Series", options, choice.series, (v) => { choice.series = v; choice.noSeries = v === ""; }));
        }
        for (const dim of this.fixedDims()) {
          const axis = this.axis(dim);
          const options = axis.values.map((value, i) => [i, String(value)]);
          boxes.push(this.select(`fixed-${dim}`, `${labelled(axis)} =`, options, this.index(dim), (v) => { choice.fixed[dim] = Number(v); }));
        }
      }
      const scales = [["", "automatic"], ["linear", "linear"], ["log", "logarithmic"]];
      boxes.push(this.select("scale", "Scale of y", scales, choice.scale, (v) => { choice.scale = v; }));
      this.element.querySelector(".controls").replaceChildren(...boxes);
    }

    fixedDims() {
      const used = [this.choice.x, this.choice.series].filter(Boolean).map((name) => this.axis(name).dim);
      return this.quantity.dims.filter((dim) => !used.includes(dim));
    }

    // The numbers of one series: columns in the order of x; a value that is missing is left out or breaks a line.
    columns(number) {
      const { choice, quantity } = this;
      const x = choice.x ? this.axis(choice.x) : null;
      const series = choice.series ? this.axis(choice.series) : null;
      const count = x ? x.values.length : 1;
      const rows = [];
      for (let i = 0; i < count; i += 1) {
        let flat = 0;
        for (const dim of quantity.dims) {
          let index = this.index(dim);
          if (x && dim === x.dim) index = i;
          else if (series && dim === series.dim) index = number;
          flat = flat * this.size(dim) + Math.min(index, this.size(dim) - 1);
        }
        const at = (part) => (quantity[part] ? nan(quantity[part][flat]) : NaN);
        rows.push({ x: x ? x.values[i] : "", i, value: at("value"), error: at("error"), predicted: at("predicted"), published: at("published"), rounding: at("published_rounding") });
      }
      if (x && x.numeric) rows.sort((a, b) => a.x - b.x);
      return rows.filter((row) => row.x !== null);
    }

    async draw() {
      this.turn += 1;
      const turn = this.turn;
      this.controls();
      const { choice, quantity } = this;
      const x = choice.x ? this.axis(choice.x) : null;
      const series = choice.series ? this.axis(choice.series) : null;
      const total = series ? series.values.length : 1;
      const drawn = Math.min(total, MOST_SERIES);
      const numeric = x !== null && x.numeric;
      const factors = x && !numeric ? this.factors(x) : [""];
      const everything = Array.from({ length: drawn }, (_, number) => this.columns(number));
      const flat = everything.flat();
      const positive = flat.every((row) => !(row.value <= 0));
      const scale = choice.scale || quantity.scale || (isLogarithmic(flat.map((row) => row.value)) && !quantity.unit.match(/^(mag|dB|dex)$/) ? "log" : "linear");
      const logY = scale === "log" && positive;
      const logX = numeric && x.logarithmic;
      const ink = colour(this.element, "ink");
      const line = colour(this.element, "line");
      const page = colour(this.element, "page");
      const figure = Bokeh.Plotting.figure({
        height: 416,
        sizing_mode: "stretch_width",
        tools: "pan,box_zoom,wheel_zoom,reset,save",
        x_axis_type: numeric ? (logX ? "log" : "linear") : "auto",
        y_axis_type: logY ? "log" : "linear",
        ...(numeric ? {} : { x_range: new Bokeh.FactorRange({ factors }) }),
        x_axis_label: plain(x ? labelled(x) : ""),
        y_axis_label: plain(this.labelOf(quantity)),
        background_fill_color: page, // a transparent figure shows what was painted before its last layout
        border_fill_color: page,
        outline_line_color: line,
      });
      figure.toolbar.logo = null;
      figure.toolbar.active_scroll = null;
      if (quantity.truth) {
        [...figure.yaxis][0].ticker = [...figure.ygrid][0].ticker = new Bokeh.FixedTicker({ ticks: [0, 1] });
        [...figure.yaxis][0].major_label_overrides = new Map([[0, "False"], [1, "True"]]);
      }
      if (logX) labelShort([...figure.xaxis][0], [...figure.xgrid][0], x.values);
      if (logY) labelShort([...figure.yaxis][0], [...figure.ygrid][0], flat.map((row) => row.value));
      this.dress(figure, ink, line);
      const legend = [];
      const values = [];
      this.drawn = [];
      everything.forEach((rows, number) => {
        const name = series ? String(series.values[number]) : quantity.name;
        const parts = this.series(figure, rows, { name, number, numeric, joined: numeric && x.ordered && !quantity.truth, factors, logY });
        this.drawn[number] = parts.kinds;
        if (parts.renderers.length) legend.push(new Bokeh.LegendItem({ label: plain(series ? `${series.name} = ${name}` : name), renderers: parts.renderers }));
        values.push(...parts.values);
      });
      for (const [part, text] of [["predicted", "predicted"], ["published", "published"], ["error", "one-sigma error"]]) {
        const renderers = everything.flatMap((_, number) => this.drawn[number]?.[part] ?? []);
        if (renderers.length) legend.push(new Bokeh.LegendItem({ label: text, renderers: [this.sign(figure, part, renderers, ink, x, factors)] }));
      }
      this.hover(figure, values, x);
      if (legend.length > 1 || quantity.predicted || quantity.published) {
        const box = new Bokeh.Legend({ items: legend, click_policy: "hide", orientation: "horizontal", location: "left", ncols: this.element.clientWidth < 500 ? 1 : 4, background_fill_alpha: 0, border_line_alpha: 0, label_text_color: ink, label_text_font_size: "12px", inactive_fill_alpha: 0.5 });
        figure.add_layout(box, "below");
      }
      const target = document.createElement("div");
      const view = await Bokeh.Plotting.show(figure, target);
      if (turn !== this.turn) { // a later choice was drawn meanwhile
        forget(view);
        return;
      }
      this.element.querySelector(".plot").replaceChildren(target);
      if (this.view) forget(this.view);
      this.view = view;
      this.note(flat, total, drawn, logY);
      this.element.dataset.drawn = this.isDark() ? "dark" : "light";
      this.element.dataset.turn = String(turn);
    }

    showTools(visible) {
      if (this.view) this.view.model.toolbar.visible = visible;
    }

    isDark() {
      const set = document.documentElement.dataset.theme;
      return set ? set === "dark" : window.matchMedia("(prefers-color-scheme: dark)").matches;
    }

    // A name that occurs twice along an axis gets its position as a number.
    factors(axis) {
      const names = axis.values.map((value) => (value === null ? "missing" : plain(value)));
      return names.map((name, i) => (names.indexOf(name) === i ? name : `${name} (${i + 1})`));
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
      const at = (part, others = {}) => {
        const kept = rows.filter((row) => Number.isFinite(row[part]) && !(logY && row[part] <= 0));
        const source = { x: kept.map(place), y: kept.map((row) => row[part]) };
        for (const [key, make] of Object.entries(others)) source[key] = kept.map(make);
        return new Bokeh.ColumnDataSource({ data: source });
      };
      const lowest = (centre, half) => (logY && centre - half <= 0 ? centre / 10 : centre - half);
      const renderers = [];
      const values = [];
      const main = at("value", {
        name: () => name,
        place: (row) => (row.x === "" ? "" : String(row.x)),
        value: (row) => (this.quantity.truth ? ["False", "True"][row.value] : withError(row.value, row.error)),
        predicted: (row) => shown(row.predicted),
        published: (row) => shown(row.published),
        low: (row) => lowest(row.value, row.error > 0 ? row.error : 0),
        high: (row) => row.value + (row.error > 0 ? row.error : 0),
      });
      const kinds = { predicted: [], published: [], error: [] };
      const heights = rows.map((row) => (logY && row.value <= 0 ? NaN : row.value));
      if (joined && heights.filter(Number.isFinite).length > 1) {
        renderers.push(figure.line(rows.map(place), heights, { line_color: tint, line_width: 1, line_alpha: 0.55 }));
      }
      if (this.quantity.predicted) { // known at the points alone
        const predicted = at("predicted");
        if (predicted.data.x.length) {
          const dash = figure.scatter({ field: "x" }, { field: "y" }, { source: predicted, marker: "dash", size: 22, line_color: tint, line_width: 2 });
          renderers.push(dash);
          kinds.predicted.push(dash);
        }
      }
      if (this.quantity.error && main.data.x.length) {
        const segments = figure.segment({ field: "x" }, { field: "low" }, { field: "x" }, { field: "high" }, { source: main, line_color: tint, line_width: 1.5 });
        renderers.push(segments);
        kinds.error.push(segments);
      }
      if (main.data.x.length) {
        const points = figure.scatter({ field: "x" }, { field: "y" }, { source: main, marker, size: 7, fill_color: tint, line_color: tint });
        renderers.push(points);
        values.push(points);
      }
      if (this.quantity.published) {
        const published = at("published");
        if (published.data.x.length) {
          const open = figure.scatter({ field: "x" }, { field: "y" }, { source: published, marker, size: 14, fill_alpha: 0, line_color: tint, line_width: 1.5 });
          renderers.push(open);
          kinds.published.push(open);
        }
      }
      return { renderers, values, kinds };
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

    hover(figure, renderers, x) {
      const rows = [[this.choice.series || "quantity", "@name"]];
      if (x) rows.push([labelled(x), "@place"]);
      rows.push([this.labelOf(this.quantity), "@value"]);
      for (const part of ["predicted", "published"]) if (this.quantity[part]) rows.push([part, `@${part}`]);
      figure.add_tools(new Bokeh.HoverTool({ renderers, tooltips: rows.map(([name, value]) => [plain(name).replaceAll("@", "＠").replaceAll("$", "＄"), value]) }));
    }

    note(flat, total, drawn, logY) {
      const parts = [];
      if (this.quantity.meaning) parts.push(`${this.quantity.name}: ${this.quantity.meaning}.`);
      if (this.quantity.error) parts.push("Bars are one-sigma errors.");
      if (this.quantity.predicted) parts.push("Dashes are predicted.");
      if (this.quantity.published) parts.push("Published values are large open symbols.");
      if (drawn < total) parts.push(`The first ${drawn} of ${total} series are drawn; exchange x and series to see all.`);
      const gone = flat.filter((row) => !Number.isFinite(row.value)).length;
      if (gone) parts.push(`${gone} of ${flat.length} values are missing and not drawn.`);
      if ((this.choice.scale || this.quantity.scale) === "log" && !logY) parts.push("There are values that are not above zero: the scale stays linear.");
      this.element.querySelector(".status").textContent = parts.join(" ");
    }
  }

  for (const element of document.querySelectorAll("[data-explorer]")) new Explorer(element);
})();
