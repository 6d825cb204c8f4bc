// What a page does besides being read: tables sort and filter, the block turns, and an image or a point that is chosen
// in one place shows in the others. Without it, and in print, the page has all its tables and still pictures.
{
  const LONG_TABLE = 12, NARROW = 600, WIDE = 620;
  // As in block_in_space.py of colours that those who see no red or green tell apart.
  const OF_IMAGE = "#e69f00", OF_POINT = "#f0308a", BLUE = "#2f8fd0", GREY = "#8a8f96";
  const NOTHING = { x: [], y: [], z: [] };
  // Length of an arrow of three times the rms residual, as a part of the width of the format.
  const ARROW = 0.06;
  const HEADS = { image: "image", photograph: "image", point: "point" };
  const chosen = { image: null, point: null };
  const listeners = [];

  const made = (tag, properties = {}, ...children) => {
    const element = Object.assign(document.createElement(tag), properties);
    element.append(...children);
    return element;
  };

  // ---- tables

  // A number, and after it at most a unit or what it is good to: "-1.5e-05", "0.35 px", "12 +- 3", "< 1e-300".
  const NUMBER = /^(< )?[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?($|[\s(,/%])/i;
  const order = new Intl.Collator(undefined, { numeric: true });

  // Of a cell that holds several numbers, that by which it sorts.
  const valueOf = (cell) => cell.dataset.value ?? cell.textContent.trim();

  const sortBy = (table, heads, column) => {
    const head = heads[column], falling = head.getAttribute("aria-sort") === "ascending";
    const rows = [...table.tBodies[0].rows], texts = rows.map((row) => valueOf(row.cells[column]));
    const told = texts.filter((text) => text && text !== "-");
    const number = told.filter((text) => NUMBER.test(text)).length > told.length / 2;
    const key = (text) => (!number ? text : NUMBER.test(text) ? parseFloat(text.replace("< ", "")) : NaN);
    const keyed = rows.map((row, k) => ({ row, key: key(texts[k]) }));
    // What is no number, and what is empty, comes last either way.
    const none = (key) => (number ? Number.isNaN(key) : key === "");
    keyed.sort((a, b) => none(a.key) - none(b.key)
      || (none(a.key) ? 0 : (falling ? -1 : 1) * (number ? a.key - b.key : order.compare(a.key, b.key))));
    for (const other of heads) other.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", falling ? "descending" : "ascending");
    table.tBodies[0].append(...keyed.map(({ row }) => row));
  };

  const addFilter = (table) => {
    const rows = [...table.tBodies[0].rows], count = made("output");
    const field = made("input", { type: "search", size: 14 });
    field.addEventListener("input", () => {
      const words = field.value.toLowerCase().split(/\s+/).filter(Boolean);
      let shown = 0;
      for (const row of rows) {
        const text = row.textContent.toLowerCase();
        row.hidden = !words.every((word) => text.includes(word));
        shown += !row.hidden;
      }
      count.textContent = words.length ? `${shown} of ${rows.length} rows` : "";
    });
    table.parentElement.before(made("div", { className: "filter" }, made("label", {}, "Filter ", field), " ", count));
  };

  const nameButton = (cell, of) => {
    const name = cell.textContent;
    if (!name) return;
    const button = made("button", { type: "button", className: "name", title: `choose this ${of}` }, name);
    button.addEventListener("click", () => choose(of, chosen[of] === name ? null : name));
    cell.replaceChildren(button);
    listeners.push((kind) => {
      if (kind !== of) return;
      const mine = chosen[of] === name;
      button.setAttribute("aria-pressed", mine);
      button.closest("tr").classList.toggle("is-chosen", [...button.closest("tr").querySelectorAll(".name")]
        .some((other) => other.getAttribute("aria-pressed") === "true"));
      const box = button.closest(".long");
      // Within its box only: the page stays where it is.
      if (mine && box) box.scrollTop = button.closest("tr").offsetTop - box.clientHeight / 2;
    });
  };

  const prepareTable = (table, linked) => {
    const heads = [...table.tHead.rows[0].cells], rows = [...table.tBodies[0].rows];
    heads.forEach((head, column) => {
      const of = HEADS[head.textContent.trim()];
      if (linked && of) for (const row of rows) nameButton(row.cells[column], of);
      if (rows.length < 2 || !head.textContent.trim()) return;
      const button = made("button", { type: "button", title: "sort by this column" }, ...head.childNodes);
      head.append(button);
      button.addEventListener("click", () => sortBy(table, heads, column));
    });
    if (rows.length >= LONG_TABLE) addFilter(table);
  };

  // ---- what is larger than its box: keys reach it, and the edge fades that more is behind

  const markEdges = (box) => {
    const right = box.scrollWidth - box.clientWidth, down = box.scrollHeight - box.clientHeight;
    box.classList.toggle("more-right", box.scrollLeft < right - 1);
    box.classList.toggle("more-below", box.scrollTop < down - 1);
    if (right > 1 || down > 1) box.tabIndex = 0;
  };
  const sized = new ResizeObserver((entries) => entries.forEach(({ target }) => markEdges(target.closest(".wide"))));
  let heading = "";
  for (const part of document.querySelectorAll("h2, h3, .wide")) {
    if (!part.matches(".wide")) { heading = part.textContent; continue; }
    part.setAttribute("role", "region");
    part.setAttribute("aria-label", heading || document.title);
    part.addEventListener("scroll", () => markEdges(part), { passive: true });
    sized.observe(part);
    if (part.firstElementChild) sized.observe(part.firstElementChild);
  }

  // ---- what is packed in the page

  const unpacked = async (element) => {
    const letters = atob(element.textContent), bytes = new Uint8Array(letters.length);
    for (let k = 0; k < letters.length; k++) bytes[k] = letters.charCodeAt(k);
    return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
  };

  const ARRAYS = { i2: Int16Array, i4: Int32Array, f4: Float32Array };
  const numbers = ({ dtype, bdata }) => {
    const letters = atob(bdata), bytes = new Uint8Array(letters.length);
    for (let k = 0; k < letters.length; k++) bytes[k] = letters.charCodeAt(k);
    return new ARRAYS[dtype](bytes.buffer);
  };

  let measured = null;
  // Rays and residuals of all images: unpacked when something is chosen for the first time.
  const measurements = () => {
    measured ??= unpacked(document.getElementById("measurements")).then((text) => {
      const m = JSON.parse(text);
      for (const name of ["first", "point", "xy", "v", "stations", "places"]) m[name] = numbers(m[name]);
      m.number = {
        image: new Map(m.images.map((name, k) => [name, k])), point: new Map(m.points.map((name, k) => [name, k])),
      };
      return m;
    });
    return measured;
  };

  const choose = (of, name) => {
    chosen[of] = name;
    for (const listener of listeners) listener(of);
  };

  // ---- figures

  const dark = matchMedia("(prefers-color-scheme: dark)");

  // A layout in the colours of the page, light or dark.
  const themed = (layout) => {
    const style = getComputedStyle(document.documentElement);
    const ink = style.getPropertyValue("--ink"), line = style.getPropertyValue("--line"), none = "rgba(0,0,0,0)";
    const withAxes = (of) => ({ ...of, ...Object.fromEntries(Object.keys(of).filter((key) => key.endsWith("axis"))
      .map((key) => [key, { ...of[key], gridcolor: line, zerolinecolor: line, linecolor: line, color: ink }])) });
    const own = { ...withAxes(layout), font: { color: ink }, paper_bgcolor: none, plot_bgcolor: none };
    if (layout.scene) own.scene = withAxes(layout.scene);
    return own;
  };

  const CONFIG = {
    responsive: true, displaylogo: false, modeBarButtonsToRemove: ["tableRotation", "resetCameraLastSave3d"],
    // Nothing leaves the page.
    showSendToCloud: false, plotlyServerURL: "",
  };

  const drawn = async (place, data, layout) => {
    await Plotly.newPlot(place, data, themed(layout), CONFIG);
    dark.addEventListener("change", () => Plotly.react(place, place.data, themed(place.layout), CONFIG));
    place.on("plotly_click", ({ points: [{ data: { meta }, text }] }) => {
      // Later: within its own event a figure is not drawn again.
      if (meta && text) setTimeout(() => choose(meta, chosen[meta] === text ? null : text));
    });
  };

  // Lines from one place to others, with gaps between.
  const lines = (pairs) => {
    const at = { x: [], y: [], z: [] };
    for (const pair of pairs) {
      for (const [k, axis] of ["x", "y", "z"].entries()) at[axis].push(pair[0][k], pair[1][k], null);
    }
    return at;
  };
  const place3 = (of, k) => of.subarray(3 * k, 3 * k + 3);

  const raysOfImage = (m, image) => {
    const rays = [];
    for (let k = m.first[image]; k < m.first[image + 1]; k++) {
      rays.push([place3(m.stations, image), place3(m.places, m.point[k])]);
    }
    return rays;
  };
  const raysOfPoint = (m, point) => {
    const rays = [];
    for (let image = 0, k = 0; image < m.images.length; image++) {
      for (; k < m.first[image + 1]; k++) {
        if (m.point[k] === point) rays.push([place3(m.stations, image), place3(m.places, point)]);
      }
    }
    return rays;
  };

  const showChosen = async (place, first) => {
    const m = chosen.image !== null || chosen.point !== null ? await measurements() : null;
    const rays = { image: [], point: [] }, marks = { image: NOTHING, point: NOTHING }, told = [];
    for (const of of ["image", "point"]) {
      const k = m?.number[of].get(chosen[of]);
      if (k === undefined) {
        // As those that could not be oriented, and those of a smaller part of a flight.
        if (chosen[of] !== null) told.push(`${of} ${chosen[of]} is not in this block`);
        continue;
      }
      rays[of] = of === "image" ? raysOfImage(m, k) : raysOfPoint(m, k);
      const [x, y, z] = place3(of === "image" ? m.stations : m.places, k);
      marks[of] = { x: [x], y: [y], z: [z] };
      told.push(`${of} ${chosen[of]}: ${rays[of].length} rays`);
    }
    const all = [lines(rays.image), lines(rays.point), marks.image, marks.point];
    await Plotly.restyle(place, Object.fromEntries(["x", "y", "z"].map((axis) => [axis, all.map((one) => one[axis])])),
      all.map((_, k) => first + k));
    return told.join("; ");
  };

  const showResiduals = async (place) => {
    const m = chosen.image === null ? null : await measurements(), image = m?.number.image.get(chosen.image);
    place.parentElement.hidden = image === undefined;
    if (image === undefined) return;
    const { width_mm: width, height_mm: height, pixel_mm: pixel } = m.cameras[m.camera[image]];
    const from = m.first[image], to = m.first[image + 1], x = [], y = [], vx = [], vy = [];
    let square = 0;
    for (let k = from; k < to; k++) {
      x.push(m.xy[2 * k] * m.xy_step_mm);
      y.push(m.xy[2 * k + 1] * m.xy_step_mm);
      vx.push(m.v[2 * k] * m.v_step_mm);
      vy.push(m.v[2 * k + 1] * m.v_step_mm);
      square += vx.at(-1) ** 2 + vy.at(-1) ** 2;
    }
    const rms = Math.sqrt(square / Math.max(1, 2 * x.length));
    const factor = Number(((ARROW * width) / (3 * rms || 1)).toPrecision(1));
    const arrows = { x: [], y: [] };
    x.forEach((at, k) => {
      arrows.x.push(at, at + factor * vx[k], null);
      arrows.y.push(y[k], y[k] + factor * vy[k], null);
    });
    const names = x.map((_, k) => m.points[m.point[from + k]]), isChosen = (name) => name === chosen.point;
    const around = [-1, 1, 1, -1, -1];
    const data = [
      { x: around.map((s) => (s * width) / 2), y: [-1, -1, 1, 1, -1].map((s) => (s * height) / 2), mode: "lines",
        line: { color: GREY, width: 1 }, hoverinfo: "skip" },
      { ...arrows, mode: "lines", line: { color: BLUE, width: 1.2 }, hoverinfo: "skip" },
      { x, y, mode: "markers", meta: "point", text: names, customdata: vx.map((v, k) => [v / pixel, vy[k] / pixel]),
        marker: {
          size: names.map((name) => (isChosen(name) ? 12 : 5)),
          color: names.map((name) => (isChosen(name) ? OF_POINT : BLUE)),
        },
        hovertemplate: "point %{text}<br>%{customdata[0]:.2f}, %{customdata[1]:.2f} px<extra></extra>" },
    ];
    const layout = {
      showlegend: false, dragmode: "pan", margin: { l: 50, r: 10, t: 10, b: 40 },
      xaxis: { title: { text: "x [mm]" }, range: [-0.56 * width, 0.56 * width], constrain: "domain", zeroline: false },
      yaxis: {
        title: { text: "y [mm]" }, range: [-0.56 * height, 0.56 * height], constrain: "domain", scaleanchor: "x",
        zeroline: false,
      },
    };
    place.previousElementSibling.textContent = `Residuals of image ${chosen.image}, ${factor.toLocaleString("en")} times: `
      + `${x.length} image points, rms ${(rms / pixel).toFixed(2)} px`;
    await drawn(place, data, layout);
  };

  const chooser = (names, said) => {
    const image = made("select", {}, made("option", { value: "" }, "none"),
      ...names.map((name) => made("option", { value: name }, name)));
    const point = made("input", { type: "search", size: 10 });
    image.addEventListener("change", () => choose("image", image.value || null));
    point.addEventListener("change", async () => {
      const name = point.value.trim(), known = !name || (await measurements()).number.point.has(name);
      point.setCustomValidity(known ? "" : "there is no such point");
      if (point.reportValidity()) choose("point", name || null);
    });
    listeners.push(() => {
      image.value = chosen.image ?? "";
      point.value = chosen.point ?? "";
      point.setCustomValidity("");
    });
    return made("div", { className: "chooser", role: "group", ariaLabel: "What is chosen" },
      made("label", {}, "Image ", image), " ", made("label", {}, "Point ", point), " ", said);
  };

  const drawBlock = async (figure) => {
    const { data, layout } = JSON.parse(await unpacked(figure.querySelector("script")));
    const first = data.length, own = { ...NOTHING, type: "scatter3d", hoverinfo: "skip", showlegend: false };
    for (const [color, width] of [[OF_IMAGE, 2], [OF_POINT, 4]]) {
      data.push({ ...own, mode: "lines", line: { color, width } });
    }
    for (const color of [OF_IMAGE, OF_POINT]) data.push({ ...own, mode: "markers", marker: { color, size: 9 } });
    const place = made("div", { className: "plot", role: "group", ariaLabel: figure.querySelector("img").alt });
    const said = made("output");
    const names = data.filter(({ meta }) => meta === "image").flatMap(({ text }) => text);
    const residuals = made("div", { className: "plot flat" });
    figure.append(chooser(names, said), place, made("div", { hidden: true }, made("p"), residuals));
    figure.dataset.drawn = "";
    // From farther off where the figure is narrow, so that its axes are in it.
    if (place.clientWidth < NARROW) for (const axis of ["x", "y", "z"]) layout.scene.camera.eye[axis] *= 1.4;
    await drawn(place, data, layout);
    const show = async () => {
      said.textContent = await showChosen(place, first);
      await showResiduals(residuals);
    };
    listeners.push(show);
    if (chosen.image !== null || chosen.point !== null) await show();
    performance.mark("figures drawn");
  };

  // Of a twin, which matplotlib drew on white: in the dark greys are turned round. What has a scale of colours stays.
  const GREY_OF = /^rgba\((\d+),\1,\1,/, BRIGHTEST = 235, REACH = 0.8, WHITE = "255";
  const lightened = (key, value) => {
    if (Array.isArray(value) && key === "color") return value.map((one) => lightened(key, one));
    if ((key !== "color" && key !== "fillcolor") || typeof value !== "string") return value;
    const grey = GREY_OF.exec(value)?.[1];
    if (grey === undefined || grey === WHITE) return value;
    const turned = Math.round(BRIGHTEST - REACH * grey);
    return value.replace(`rgba(${grey},${grey},${grey},`, `rgba(${turned},${turned},${turned},`);
  };
  const scaled = ({ data }) => data.some(({ type, marker }) => type === "heatmap" || marker?.colorscale);

  const twinsFrom = (text) => {
    const plain = JSON.parse(text);
    return !dark.matches ? plain : JSON.parse(text, lightened).map((twin, k) => (scaled(plain[k]) ? plain[k] : twin));
  };

  // One beside the other as far as there is room; their titles break into lines, which those of plotly do not.
  const drawTwins = async (figure) => {
    const text = await unpacked(figure.querySelector("script"));
    const alts = [...figure.querySelectorAll("img")].map((image) => image.alt);
    const twins = twinsFrom(text), box = made("div", { className: "pictures" });
    figure.append(box);
    figure.dataset.drawn = "";
    const shown = (twin, place) => {
      const { width, height, title, ...layout } = twin.layout;
      const margin = { l: 50, r: 20, t: 30, b: 45 };
      // A finger moves the page, not the picture.
      const dragmode = matchMedia("(pointer: coarse)").matches ? false : "zoom";
      const legend = { orientation: "h", x: 0, y: 1, xanchor: "left", yanchor: "bottom" };
      const own = themed({ ...layout, margin, dragmode, legend });
      // Colours mean what their scale says on white alone.
      if (dark.matches && scaled(twin)) own.plot_bgcolor = "#e8e8e8";
      return Plotly.react(place, twin.data, own, CONFIG);
    };
    const places = twins.map(({ layout: { width, height, title } }, k) => {
      const words = title.text.replaceAll("<br>", " ");
      const alt = alts.length === twins.length ? alts[k] : `${alts[0]}: ${words}`;
      const place = made("div", { className: "plot", role: "group", ariaLabel: alt });
      place.style.aspectRatio = `${width} / ${height}`;
      const className = width > WIDE ? "full" : "";
      box.append(made("div", { className }, made("p", { className: "title" }, words), place));
      return place;
    });
    await Promise.all(twins.map((twin, k) => shown(twin, places[k])));
    dark.addEventListener("change", () => twinsFrom(text).forEach((twin, k) => shown(twin, places[k])));
  };

  let loaded = null;
  // plotly, once. Reading five megabytes of it takes longer than anything else that a figure waits for.
  const plotly = () => {
    loaded ??= unpacked(document.getElementById("plotly")).then((textContent) => {
      document.head.append(made("script", { textContent }));
    });
    return loaded;
  };

  // When it comes into sight: a page is there to be read before its figures are drawn.
  const drawInSight = (figure, draw) => {
    const observer = new IntersectionObserver(async ([{ isIntersecting }]) => {
      if (!isIntersecting) return;
      observer.disconnect();
      await plotly();
      await draw(figure);
    }, { rootMargin: "300px" });
    observer.observe(figure);
    // While somebody reads the verdict.
    const whenIdle = window.requestIdleCallback ?? ((task) => setTimeout(task, 1000));
    addEventListener("load", () => whenIdle(plotly));
  };

  const block = document.querySelector("figure.block"), canDraw = Boolean(window.DecompressionStream);
  // Where a browser draws nothing in space, the still picture stays.
  const canTurn = block && canDraw && window.WebGLRenderingContext;
  for (const table of document.querySelectorAll("table:has(thead)")) prepareTable(table, canTurn);
  if (canTurn) drawInSight(block, drawBlock);
  if (canDraw) for (const figure of document.querySelectorAll("figure.twins")) drawInSight(figure, drawTwins);
}
