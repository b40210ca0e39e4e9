// Puts the parts together: contents, tables, and plots and list of the samples if the page has samples.

document.documentElement.classList.add("js");

/** Marks the section in view among the contents. */
function followContents() {
  const links = new Map([...document.querySelectorAll(".contents a")].map(link => [link.hash.slice(1), link]));
  const inView = new Set();
  const observer = new IntersectionObserver(entries => {
    for (const { target, isIntersecting } of entries) inView[isIntersecting ? "add" : "delete"](target.id);
    const first = [...links.keys()].find(id => inView.has(id));
    for (const [id, link] of links) id === first ? link.setAttribute("aria-current", "true") : link.removeAttribute("aria-current");
  }, { rootMargin: "-10% 0px -60% 0px" });
  for (const id of links.keys()) observer.observe(document.getElementById(id));
}

/** On a small screen, hides the content of all sections until their heading is pressed or a link or button leads there. */
function foldSections() {
  if (!matchMedia("(max-width: 640px)").matches) return;
  for (const section of document.querySelectorAll("main > section[id]")) {
    const title = section.querySelector("h2"), button = element("button", { type: "button", className: "fold" }, ...title.childNodes);
    const fold = isFolded => {
      section.classList.toggle("folded", isFolded);
      button.setAttribute("aria-expanded", String(!isFolded));
      if (!isFolded) dispatchEvent(new Event("resize")); // plots of hidden sections have no width
    };
    title.append(button);
    button.addEventListener("click", () => fold(!section.classList.contains("folded")));
    document.querySelector(`.contents a[href="#${section.id}"]`)?.addEventListener("click", () => fold(false));
    fold(location.hash.slice(1) !== section.id);
  }
}

function choice(type, name, text, isChecked, change, color) {
  const input = element("input", { type, name, checked: isChecked });
  input.addEventListener("change", () => change(input.checked));
  const swatch = color ? [element("span", { className: "swatch" })] : [];
  if (color) swatch[0].style.setProperty("--mark", `var(--${color})`);
  return element("label", {}, input, ...swatch, text);
}

/** Controls of what the plots show. */
function showControls(selection) {
  const { samples } = selection, first = document.querySelector(".plot[data-y^='error:']")?.closest("section");
  if (!first) return;
  const bar = element("div", { className: "tools script", id: "shown" });
  if (samples.hasBefore) {
    const states = element("fieldset", {}, element("legend", {}, "Errors"));
    for (const state of ["before", "after", "both"])
      states.append(choice("radio", "state", state, state === selection.state, () => selection.update({ state }), { before: "before", after: "after" }[state]));
    bar.append(states);
  }
  const roles = samples.roles.length > 1 ? samples.roles.map(role => [role, role, role === "fitted" ? "sample" : "holdout"]) : [];
  if (samples.outlier.includes(1)) roles.push(["outlier", "outliers", "outlier"]);
  if (roles.length) {
    const sets = element("fieldset", {}, element("legend", {}, "Samples"));
    for (const [role, text, color] of roles)
      sets.append(choice("checkbox", role, text, true, isShown => {
        const hidden = new Set(selection.hidden);
        isShown ? hidden.delete(role) : hidden.add(role);
        selection.update({ hidden });
      }, color));
    bar.append(sets);
  }
  bar.append(element("span", {}, "Hover over a dot for its sample, click to select it, drag to select several."));
  first.querySelector("h2").after(bar);
  // The controls are the legend of the dots.
  for (const plot of document.querySelectorAll(".plot[data-x^='joint:']"))
    for (const item of plot.closest(".panels").previousElementSibling.querySelectorAll("li")) if (item.textContent.trim() === "sample") item.remove();
  selection.views.push(change => {
    if ("state" in change || "hidden" in change)
      for (const figure of document.querySelectorAll("figure[data-role]")) figure.hidden = selection.hidden.has(figure.dataset.role);
    document.body.classList.toggle("state-before-only", selection.state === "before");
  });
}

/** Buttons that save the files of the page. */
function showDownloads(samples) {
  const names = Object.keys(samples.downloads), section = document.getElementById("samples");
  if (!names.length || !section) return;
  const bar = element("div", { className: "tools script" });
  for (const name of names) {
    const button = element("button", { type: "button" }, `Download ${name}`);
    button.addEventListener("click", () => {
      const address = URL.createObjectURL(new Blob([samples.downloads[name]], { type: "text/csv" }));
      element("a", { href: address, download: name }).click();
      setTimeout(() => URL.revokeObjectURL(address), 1000);
    });
    bar.append(button);
  }
  section.querySelector("h2").after(bar);
}

/** Text beside the pointer, which screen readers read out. */
function createTooltip(samples) {
  const box = element("div", { className: "tooltip", hidden: true }), spoken = element("p", { className: "quiet", ariaLive: "polite" });
  document.body.append(box, spoken);
  return (i, event) => {
    box.hidden = i === null;
    if (i === null) return;
    const lines = [`${samples.place(i)} (${samples.setText(i)})`, ...[...samples.errorTexts(i), ...samples.jointTexts(i)].map(pair => pair.join(": "))];
    box.textContent = spoken.textContent = lines.join("\n");
    const { offsetWidth: width, offsetHeight: height } = box;
    const x = event.clientX + 16, y = event.clientY + 16;
    box.style.left = `${Math.max(4, x + width > innerWidth - 4 ? event.clientX - width - 16 : x)}px`;
    box.style.top = `${Math.max(4, y + height > innerHeight - 4 ? event.clientY - height - 16 : y)}px`;
  };
}

/** Panel with the selected sample. */
function showSelection(selection, table, scene) {
  const { samples } = selection;
  const panel = element("aside", { className: "selection script", ariaLabel: "Selected sample", hidden: true });
  document.body.append(panel);
  const number = (value, factor = 1e3) => Object.assign(element("data", { value: String(value) }, (factor * value).toFixed(3)), {});
  selection.views.push(change => {
    if (!("current" in change)) return;
    const i = change.current;
    panel.hidden = i === null;
    if (i === null) return;
    const list = element("dl");
    for (const [name, text] of [...samples.errorTexts(i), ...samples.jointTexts(i)]) list.append(element("dt", {}, name), element("dd", {}, text));
    if (samples.hasPose(i)) {
      const degrees = 180 / Math.PI, values = samples.tool.map(column => column[i]);
      const tip = (texts, part, factor, id) => list.append(element("dt", {}, texts), element("dd", { className: id }, ...part.flatMap((value, k) => [...(k ? [", "] : []), number(value, factor)])));
      tip("tool x, y, z in the measuring frame, mm", values.slice(0, 3), 1e3, "tool-position");
      tip("tool rotation vector, °", values.slice(3), degrees, "tool-rotation");
    }
    const buttons = element("div", { className: "tools" });
    const add = (text, action) => { const button = element("button", { type: "button" }, text); button.addEventListener("click", action); buttons.append(button); };
    if (table) add("Show in table", () => table.scrollTo(i));
    if (scene && samples.hasPose(i)) add("Show in scene", () => scene.box.scrollIntoView({ block: "center" }));
    add("Close", () => selection.update({ current: null }));
    panel.replaceChildren(element("h2", {}, `${samples.place(i)} (${samples.setText(i)})`), list, buttons);
  });
}

followContents();
foldSections();
for (const table of document.querySelectorAll(".scroll > table")) if (!table.closest("#samples")) enhanceTable(table);
const source = document.getElementById("samples-data");
if (source) {
  const selection = new Selection(new Samples(JSON.parse(source.textContent)));
  showControls(selection);
  showDownloads(selection.samples);
  const section = document.getElementById("samples"), box = document.querySelector(".scene");
  const table = section?.querySelector(".scroll") ? new SampleTable(section, selection) : null;
  const scene = box ? new SceneLink(box, selection) : null;
  showSelection(selection, table, scene);
  const announce = createTooltip(selection.samples);
  for (const plot of document.querySelectorAll(".plot[data-x]")) new SamplePlot(plot, selection, announce);
  addEventListener("keydown", event => { if (event.key === "Escape" && selection.current !== null) selection.update({ current: null, chosen: null }); });
}
