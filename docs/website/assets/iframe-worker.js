// Search without a server: browsers start no worker for a page from a disk, so a hidden frame runs its script.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(address) {
      super();
      const frame = document.createElement("iframe");
      frame.hidden = true;
      frame.srcdoc = `<script>
        window.postMessage = (data) => parent.postMessage(data, "*");
        window.importScripts = (...all) => Promise.all(all.map((one) => new Promise((done, failed) => {
          const script = document.createElement("script");
          script.src = one; script.onload = done; script.onerror = failed;
          document.head.append(script);
        })));
      </` + `script><script src="${new URL(address, document.baseURI)}"></` + `script>`;
      this.loaded = new Promise((done) => { frame.onload = done; });
      window.addEventListener("message", (event) => {
        if (event.source !== frame.contentWindow) return;
        const answer = new MessageEvent("message", { data: event.data });
        this.dispatchEvent(answer);
        if (this.onmessage) this.onmessage(answer);
      });
      this.frame = frame;
      document.body ? document.body.append(frame) :
        document.addEventListener("DOMContentLoaded", () => document.body.append(frame));
    }
    postMessage(data) {
      this.loaded.then(() => this.frame.contentWindow.dispatchEvent(new MessageEvent("message", { data })));
    }
    terminate() { this.frame.remove(); }
  };
}
