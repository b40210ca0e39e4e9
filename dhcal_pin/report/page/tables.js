// Tables: sorting by a column, filtering by a text, folding of rows without a change, and the list of samples.

const MIN_FILTERED_ROWS = 8;
const PAGE_ROWS = 25;

/** Key that sorts a cell: numbers by unit and value, other texts as words. */
function sortKey(text) {
  const clean = text.trim().replaceAll("−", "-"), match = /^(-?\d+(?:\.\d+)?(?:e-?\d+)?)\s*(\S*)/.exec(clean);
  return match ? [0, match[2], Number(match[1])] : clean === "" || clean === "–" ? [2, "", 0] : [1, clean, 0];
}
const compareKeys = (a, b) => a[0] - b[0] || a[1].localeCompare(b[1], "en", { numeric: true }) || a[2] - b[2];

/** Makes the headings of a table buttons; `sort` gets the column and 1, -1 or 0 for the first order. */
function makeSortable(table, sort) {
  const headings = [...table.tHead.rows[0].cells];
  headings.forEach((heading, column) => {
    if (heading.classList.contains("bars")) return;
    const button = element("button", { type: "button", title: "Sort by this column" }, ...heading.childNodes);
    button.addEventListener("click", () => {
      const next = { none: "ascending", ascending: "descending", descending: "none" }[heading.getAttribute("aria-sort") ?? "none"];
      for (const other of headings) other.removeAttribute("aria-sort");
      if (next !== "none") heading.setAttribute("aria-sort", next);
      sort(column, { ascending: 1, descending: -1, none: 0 }[next]);
    });
    heading.append(button);
  });
}

function filterInput(label, apply) {
  const input = element("input", { type: "search" });
  input.addEventListener("input", () => apply(input.value.trim().toLowerCase().split(/\s+/).filter(Boolean)));
  return element("label", {}, label, input);
}

/** Tools of a table that the page already contains. */
function enhanceTable(table) {
  const bodies = [...table.tBodies], order = bodies.map(body => [...body.rows]);
  const rows = order.flat().filter(row => !row.classList.contains("group"));
  if (rows.length < 2) return;
  makeSortable(table, (column, direction) => {
    table.classList.toggle("sorted", direction !== 0);
    if (!direction) return bodies.forEach((body, k) => body.append(...order[k]));
    const keyed = rows.map((row, k) => [sortKey(row.cells[column].textContent), row, k]);
    bodies[0].append(...keyed.sort(([a, , i], [b, , j]) => direction * compareKeys(a, b) || i - j).map(([, row]) => row));
  });
  const tools = element("div", { className: "tools script" });
  if (rows.length >= MIN_FILTERED_ROWS) {
    const count = element("output");
    tools.append(filterInput("Filter", words => {
      let matches = 0;
      order.forEach(group => {
        const heading = group.find(row => row.classList.contains("group"))?.textContent ?? "";
        let visible = 0;
        for (const row of group) {
          const text = `${heading} ${row.textContent}`.toLowerCase();
          if (row.classList.contains("group")) continue;
          row.hidden = !words.every(word => text.includes(word));
          visible += !row.hidden;
        }
        if (group[0]?.classList.contains("group")) group[0].hidden = !visible;
        matches += visible;
      });
      count.value = words.length ? `${matches} of ${rows.length} rows` : "";
    }), count);
  }
  const folded = rows.filter(row => row.classList.contains("zero")).length;
  if (folded) {
    table.classList.add("folded");
    const button = element("button", { type: "button", ariaExpanded: "false" });
    const label = () => { button.textContent = `${table.classList.contains("folded") ? "Show" : "Fold"} ${folded} ${folded > 1 ? "parameters" : "parameter"} without a change`; };
    button.addEventListener("click", () => { button.ariaExpanded = String(!table.classList.toggle("folded")); label(); });
    label();
    tools.append(button);
    // A group whose rows are all folded keeps its heading; it says how many there are.
    bodies.forEach((body, k) => {
      const heading = body.querySelector(".group th"), zeros = order[k].filter(row => row.classList.contains("zero")).length;
      if (heading && zeros) heading.append(` – ${zeros} of ${order[k].length - 1} without a change`);
    });
  }
  if (tools.childElementCount) table.parentElement.before(tools);
}

/** List of all samples, which replaces the short list of the page. */
class SampleTable {
  constructor(section, selection) {
    const { samples } = selection;
    Object.assign(this, { section, selection, samples, page: 0, words: [], sorting: [0, 0] });
    this.columns = [
      ...(samples.files.length > 1 ? [["file", i => samples.files[samples.file[i]]]] : []),
      ["line", i => samples.line[i]],
      ["set", i => samples.setText(i)],
      ...samples.joints.map(({ name, unit, factor }, j) => [`${name}, ${unit}`, i => samples.q[j][i] === null ? NaN : factor * samples.q[j][i], 2]),
      ...samples.groups.flatMap(({ key, label, unit, factor }) => Object.entries(samples.errors[key]).map(([state, values]) =>
        [Object.keys(samples.errors[key]).length > 1 ? `${label} ${state}, ${unit}` : `${label}, ${unit}`, i => values[i] === null ? NaN : factor * values[i], 3])),
    ];
    this.table = element("table", { className: "samples wide" });
    const header = this.table.createTHead().insertRow();
    for (const [title, , decimals] of this.columns) {
      // A long name may be broken after an underscore.
      const parts = title.split(/(?<=_)/).flatMap((part, k) => k ? [element("wbr"), part] : [part]);
      header.append(element("th", { scope: "col", className: decimals || title === "line" ? "number" : "" }, ...parts));
    }
    if (samples.files.length === 1) this.table.createCaption().textContent = samples.files[0];
    this.body = this.table.createTBody();
    makeSortable(this.table, (column, direction) => { this.sorting = [column, direction]; this.page = 0; this.show(); });
    this.status = element("output");
    this.earlier = element("button", { type: "button", textContent: "Previous rows" });
    this.later = element("button", { type: "button", textContent: "Next rows" });
    this.all = element("button", { type: "button", textContent: "Show all samples", hidden: true });
    this.earlier.addEventListener("click", () => { this.page--; this.show(); });
    this.later.addEventListener("click", () => { this.page++; this.show(); });
    this.all.addEventListener("click", () => selection.update({ chosen: null }));
    const tools = element("div", { className: "tools script" },
      filterInput("Filter", words => { this.words = words; this.page = 0; this.show(); }), this.earlier, this.later, this.all, this.status);
    const box = section.querySelector(".scroll");
    box.before(tools);
    box.replaceChildren(this.table);
    box.ariaLabel = "List of samples";
    // The largest errors come first, in print as well.
    const first = this.columns.findIndex(([title]) => /(after|error|residual), m/.test(title));
    if (first >= 0) {
      this.sorting = [first, -1];
      header.cells[first].setAttribute("aria-sort", "descending");
    }
    section.querySelector("p").replaceChildren(first >= 0 ? "Largest errors first. " : "",
      element("span", { className: "script" }, "Click a row, or a dot of a plot, to move the robot of the scene there."));
    this.body.addEventListener("click", event => {
      const row = event.target.closest("tr");
      if (row) selection.update({ current: Number(row.dataset.sample) });
    });
    selection.views.push(change => {
      if ("current" in change && change.current !== null) this.reveal(change.current);
      else if (!("hovered" in change) || "chosen" in change) { this.page = 0; this.show(); }
    });
    this.show();
  }
  /** Samples of the list in its order. */
  list() {
    const { samples, selection, words } = this, [column, direction] = this.sorting;
    const texts = i => `${samples.place(i)} ${samples.setText(i)}`.toLowerCase();
    let listed = [...Array(samples.count).keys()].filter(i => selection.isShown(i) && (!selection.chosen || selection.chosen.has(i)));
    if (words.length) listed = listed.filter(i => words.every(word => texts(i).includes(word)));
    if (direction) {
      const value = this.columns[column][1], keys = new Map(listed.map(i => [i, value(i)]));
      listed.sort((i, j) => {
        const a = keys.get(i), b = keys.get(j);
        if (Number.isNaN(a) || Number.isNaN(b)) return Number.isNaN(a) - Number.isNaN(b) || i - j;
        return direction * (typeof a === "string" ? a.localeCompare(b, "en", { numeric: true }) : a - b) || i - j;
      });
    }
    return listed;
  }
  show() {
    const listed = this.list(), pages = Math.max(1, Math.ceil(listed.length / PAGE_ROWS));
    this.page = Math.min(Math.max(0, this.page), pages - 1);
    const shown = listed.slice(this.page * PAGE_ROWS, (this.page + 1) * PAGE_ROWS);
    this.body.replaceChildren(...shown.map(i => this.row(i)));
    this.earlier.disabled = this.page === 0;
    this.later.disabled = this.page === pages - 1;
    this.all.hidden = !this.selection.chosen;
    this.status.value = listed.length ? `${this.page * PAGE_ROWS + 1}–${this.page * PAGE_ROWS + shown.length} of ${listed.length} samples` : "No samples";
  }
  row(i) {
    const row = element("tr", { className: i === this.selection.current ? "chosen" : "" });
    row.dataset.sample = i;
    this.columns.forEach(([title, value, decimals], column) => {
      const content = value(i), text = typeof content !== "number" || !decimals ? String(content) : Number.isNaN(content) ? "" : content.toFixed(decimals).replace("-", "−");
      const cell = element(column ? "td" : "th", { className: decimals || title === "line" ? "number" : "" });
      if (!column) cell.scope = "row";
      else cell.dataset.label = title;
      if (title === "line") cell.append(element("button", { type: "button", ariaLabel: `Select line ${text}` }, text));
      else cell.textContent = text;
      row.append(cell);
    });
    if (i === this.selection.current) row.setAttribute("aria-current", "true");
    return row;
  }
  /** Shows the page with a sample. */
  reveal(i) {
    const at = this.list().indexOf(i);
    if (at >= 0) this.page = Math.floor(at / PAGE_ROWS);
    this.show();
  }
  scrollTo(i) {
    this.body.closest("section.folded")?.querySelector(".fold").click();
    this.reveal(i);
    this.body.querySelector(".chosen")?.scrollIntoView({ block: "center" });
    this.body.querySelector(".chosen button")?.focus({ preventScroll: true });
  }
}
