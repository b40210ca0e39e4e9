// The scene in the page: moves its arm to the selected sample.

class SceneLink {
  constructor(box, selection) {
    this.box = box;
    this.frame = box.querySelector("iframe");
    this.isReady = false;
    this.wanted = null;
    addEventListener("message", ({ source, data }) => {
      if (source !== this.frame.contentWindow || !data?.dhcal) return;
      this.isReady = true;
      if (this.wanted) this.send();
    });
    selection.views.push(change => {
      if (!("current" in change)) return;
      const i = change.current;
      this.dock(i !== null && selection.samples.hasPose(i));
      if (i !== null && selection.samples.hasPose(i)) this.move(selection.samples.configuration(i));
    });
    // In its own place the scene is larger; it goes back there when that place is in view.
    new IntersectionObserver(([entry]) => {
      this.isInView = entry.isIntersecting;
      box.classList.toggle("docked", !this.isInView && this.isDocked === true);
    }, { threshold: 0.35 }).observe(box);
  }
  dock(on) {
    this.isDocked = on;
    this.box.classList.toggle("docked", on && !this.isInView);
  }
  move(q) {
    this.wanted = q;
    this.frame.loading = "eager";
    if (this.isReady) this.send();
  }
  send() {
    this.frame.contentWindow.postMessage({ q: this.wanted }, "*");
    this.wanted = null;
  }
}
