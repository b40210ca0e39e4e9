// Samples of the page, and which of them are shown and selected. The other scripts draw and list them.

const element = (tag, properties = {}, ...children) => {
  const node = Object.assign(document.createElement(tag), properties);
  node.append(...children);
  return node;
};

class Samples {
  constructor(data) {
    Object.assign(this, data);
    this.count = data.line.length;
    this.hasBefore = this.groups.some(group => data.errors[group.key].before);
  }
  /** Values of a coordinate such as "joint:2", in shown units; NaN where there is none. */
  column(name, state = "after") {
    const [kind, key] = name.split(":");
    const scaled = (values, factor) => values.map(value => value === null ? NaN : factor * value);
    if (kind === "number") return this.number;
    if (kind === "base") return scaled(this.base[key], 1);
    if (kind === "joint") return scaled(this.q[key], this.joints[key].factor);
    const group = this.groups.find(each => each.key === key);
    return scaled(this.errors[key][state] ?? this.errors[key].after, group.factor);
  }
  roleOf(i) { return this.roles[this.role[i]]; }
  place(i) { return `${this.files[this.file[i]]}:${this.line[i]}`; }
  configuration(i) { return this.q.map(values => values[i]); }
  hasPose(i) { return this.q.every(values => values[i] !== null) && this.joints.length > 0; }
  setText(i) { return this.roleOf(i) + (this.outlier[i] ? ", outlier" : ""); }
  /** Names and texts of the errors, joint positions and tool pose of a sample. */
  errorTexts(i) {
    return this.groups.flatMap(({ key, label, factor, unit }) => {
      const states = Object.entries(this.errors[key]).filter(([, values]) => values[i] !== null);
      const isOnly = Object.keys(this.errors[key]).length < 2;
      return states.map(([state, values]) => [isOnly ? label : `${label}, ${state}`, `${(factor * values[i]).toFixed(3)} ${unit}`]);
    });
  }
  jointTexts(i) {
    if (!this.hasPose(i)) return [];
    return this.joints.map(({ name, factor, unit }, j) => [name, `${(factor * this.q[j][i]).toFixed(unit === "mm" ? 2 : 3)}${unit === "°" ? "" : " "}${unit}`]);
  }
}

/** What is shown and selected; views are called when it changes. */
class Selection {
  constructor(samples) {
    this.samples = samples;
    this.state = "after";        // errors that plots show: "before", "after" or "both"
    this.hidden = new Set();     // roles that are not shown; "outlier" hides outliers of every role
    this.current = null;         // sample that was clicked
    this.hovered = null;
    this.chosen = null;          // set of samples that were dragged over; null without one
    this.views = [];
  }
  isShown(i) {
    return !this.hidden.has(this.samples.roleOf(i)) && !(this.samples.outlier[i] && this.hidden.has("outlier"));
  }
  update(change) {
    Object.assign(this, change);
    for (const view of this.views) view(change);
  }
}
