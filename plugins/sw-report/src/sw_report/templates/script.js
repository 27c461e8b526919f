"use strict";
(function () {
  const root = document.documentElement;

  // The theme: as the system says, or the other one; remembered where the browser allows it.
  const toggle = document.getElementById("theme");
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const isDark = () => (root.dataset.theme ? root.dataset.theme === "dark" : dark.matches);
  const show = () => {
    toggle.textContent = isDark() ? "Light theme" : "Dark theme";
  };
  try {
    const kept = localStorage.getItem("splatwizard-theme");
    if (kept === "dark" || kept === "light") root.dataset.theme = kept;
  } catch (e) { /* private windows and some file: pages have no storage */ }
  toggle.hidden = false;
  toggle.addEventListener("click", () => {
    root.dataset.theme = isDark() ? "light" : "dark";
    try { localStorage.setItem("splatwizard-theme", root.dataset.theme); } catch (e) { /* as above */ }
    show();
  });
  dark.addEventListener("change", show);
  show();

  window.addEventListener("beforeprint", () => {
    document.querySelectorAll("details").forEach((d) => { d.open = true; });
  });

  // Tables that a click on a heading sorts: by number where every cell of the column begins with one, unknown ones last.
  const numberOf = (cell) => {
    const text = cell.textContent.replace(/,/g, "").replace("\u2212", "-");
    return /^\s*-?[\d.]/.test(text) ? parseFloat(text) : NaN;
  };
  const isUnknown = (cell) => /^\s*[\u2013-]?\s*$/.test(cell.textContent);
  document.querySelectorAll("table.sortable").forEach((table) => {
    const heads = [...table.tHead.rows[0].cells], body = table.tBodies[0];
    heads.forEach((head, column) => {
      const button = document.createElement("button");
      button.type = "button";
      button.className = "sort";
      button.append(...head.childNodes);
      head.append(button);
      button.addEventListener("click", () => {
        const rows = [...body.rows], turn = head.getAttribute("aria-sort") === "ascending" ? -1 : 1;
        const known = rows.filter((row) => !isUnknown(row.cells[column]));
        const numeric = known.every((row) => !Number.isNaN(numberOf(row.cells[column])));
        known.sort((a, b) => turn * (numeric
          ? numberOf(a.cells[column]) - numberOf(b.cells[column])
          : a.cells[column].textContent.localeCompare(b.cells[column].textContent, "en", { numeric: true })));
        body.append(...known, ...rows.filter((row) => isUnknown(row.cells[column])));
        heads.forEach((other) => other.removeAttribute("aria-sort"));
        head.setAttribute("aria-sort", turn > 0 ? "ascending" : "descending");
      });
    });
  });

  // Two pictures of one view, one over the other, with a border that can be moved.
  const make = (tag, attributes, parent) => {
    const element = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes || {})) element.setAttribute(name, value);
    if (parent) parent.append(element);
    return element;
  };
  const picker = (parent, text, choices) => {
    const label = make("label", {}, parent);
    make("span", {}, label).textContent = text;
    const select = make("select", {}, label);
    choices.forEach((name, i) => { make("option", { value: i }, select).textContent = name; });
    return select;
  };

  document.querySelectorAll(".gallery").forEach((gallery) => {
    const strips = [...gallery.querySelectorAll(".strip")].map((strip) => ({
      name: strip.dataset.view,
      images: [...strip.querySelectorAll("img")],
    })).filter((strip) => strip.images.length > 1);
    if (!strips.length) return;

    const viewer = make("div", { class: "viewer" });
    const controls = make("div", { class: "controls" }, viewer);
    const view = picker(controls, "View", strips.map((s) => s.name));
    const left = picker(controls, "Left", []);
    const right = picker(controls, "Right", []);
    const stage = make("div", { class: "stage" }, viewer);
    const under = make("img", { alt: "" }, stage);
    const over = make("img", { alt: "" }, stage);
    const handle = make("div", { class: "handle" }, stage);
    const leftTag = make("span", { class: "tag left" }, stage);
    const rightTag = make("span", { class: "tag right" }, stage);
    const range = make("input", { type: "range", min: 0, max: 100, step: 1, value: 50,
      "aria-label": "Border between the left and the right picture, percent from the left" }, viewer);

    const fill = (select, images, wanted) => {
      select.replaceChildren();
      images.forEach((image, i) => { make("option", { value: i }, select).textContent = image.dataset.name; });
      const found = images.findIndex((image) => image.dataset.name === wanted);
      return found;
    };
    const place = () => {
      const at = Number(range.value);
      over.style.clipPath = `inset(0 ${100 - at}% 0 0)`;
      handle.style.left = `${at}%`;
      leftTag.style.visibility = at < 8 ? "hidden" : "visible";
      rightTag.style.visibility = at > 92 ? "hidden" : "visible";
    };
    const draw = () => {
      const images = strips[view.value].images;
      const a = images[left.value], b = images[right.value];
      over.src = a.src; over.alt = a.alt;
      under.src = b.src; under.alt = b.alt;
      leftTag.textContent = a.dataset.name;
      rightTag.textContent = b.dataset.name;
      const w = Number(b.getAttribute("width")), h = Number(b.getAttribute("height"));
      stage.style.aspectRatio = `${w} / ${h}`;
      stage.style.width = range.style.width = `min(100%, ${Math.round(Math.min(960, 3 * w, 640 * w / h))}px, ${(78 * w / h).toFixed(2)}vh)`;
      place();
    };
    const change = () => {
      const images = strips[view.value].images;
      const names = [left, right].map((s) => (s.selectedOptions[0] || {}).textContent);
      const l = fill(left, images, names[0]);
      const r = fill(right, images, names[1]);
      left.value = l < 0 ? 0 : l;
      right.value = r < 0 ? 1 : r;
      draw();
    };
    view.addEventListener("change", change);
    left.addEventListener("change", draw);
    right.addEventListener("change", draw);
    range.addEventListener("input", place);
    const move = (event) => {
      const box = stage.getBoundingClientRect();
      range.value = Math.round(100 * (event.clientX - box.left) / box.width);
      place();
    };
    stage.addEventListener("pointerdown", (event) => { stage.setPointerCapture(event.pointerId); move(event); });
    stage.addEventListener("pointermove", (event) => { if (event.buttons) move(event); });
    gallery.prepend(viewer);
    change();
  });
})();
