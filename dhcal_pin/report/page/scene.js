// The scene in the page: moves its arm to the selected sample.

class SceneLink {
  constructor(box, selection) {
    this.box = box;
    this.frame = box.querySelector("iframe");
    this.isReady = false;
    this.wanted = null;
    this.packed = this.frame.dataset.scene;
    this.frame.removeAttribute("data-scene");
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
    new IntersectionObserver(([entry]) => { if (entry.isIntersecting) this.load(); }, { rootMargin: "300px" }).observe(box);
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
    this.load();
    if (this.isReady) this.send();
  }
  /** Unpacks the page of the scene when it is needed. */
  async load() {
    if (!this.packed) return;
    const bytes = Uint8Array.from(atob(this.packed), character => character.charCodeAt(0));
    this.packed = null;
    this.frame.srcdoc = await new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"))).text();
  }
  send() {
    this.frame.contentWindow.postMessage({ q: this.wanted }, "*");
    this.wanted = null;
  }
}
