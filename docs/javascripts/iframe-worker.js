/* Search of the site from disk, where browsers give pages no workers: a hidden frame runs the script instead.
   The theme asks for a file of this name, and for window.IFrameWorker, where it must wait for importScripts. */
"use strict";

class FrameWorker extends EventTarget {
  constructor(url) {
    super();
    this.frame = document.createElement("iframe");
    this.frame.hidden = true;
    document.body.append(this.frame);
    const inside = (this.inside = this.frame.contentWindow);
    inside.document.open();
    inside.document.write("<body></body>");
    inside.document.close();
    inside.postMessage = (data) =>
      setTimeout(() => this.dispatchEvent(new MessageEvent("message", { data: structuredClone(data) })));
    const load = (source) =>
      new Promise((resolve, reject) => {
        const script = inside.document.createElement("script");
        Object.assign(script, { src: source, onload: resolve, onerror: reject });
        inside.document.body.append(script);
      });
    inside.importScripts = (...urls) => urls.reduce((before, next) => before.then(() => load(next)), Promise.resolve());
    this.ready = load(url);
  }

  postMessage(data) {
    this.ready.then(() => this.inside.dispatchEvent(new MessageEvent("message", { data: structuredClone(data) })));
  }

  terminate() {
    this.frame.remove();
  }
}

if (location.protocol === "file:") window.Worker = window.IFrameWorker = FrameWorker;
