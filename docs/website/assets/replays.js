// The page of replays: ?replay=NAME shows that recording in Rerun's web viewer, where that is served beside it.
(function () {
  const frame = document.getElementById("replay");
  if (!frame) return;
  const links = [...document.querySelectorAll(".replays a")];
  const wanted = new URLSearchParams(location.search).get("replay");
  const how = "renderer=webgl&persist=0&hide_welcome_screen=1&theme=dark";

  const isServed = (address) =>
    fetch(address, { method: "HEAD" }).then((answer) => answer.ok, () => false);

  function play(link) {
    const recording = encodeURIComponent(new URL(link.dataset.recording, location.href).href);
    link.classList.add("shown");
    frame.src = `viewer/index.html?url=${recording}&${how}`;
    frame.title = `Replay of ${wanted}`;
    frame.hidden = false;
  }

  async function begin() {
    if (location.protocol === "file:" || !(await isServed("viewer/index.html"))) {
      document.getElementById("replay-note").hidden = false;
      return;
    }
    let isThere = wanted === null;
    for (const link of links) {
      // An installed package carries some of the recordings only.
      if (!(await isServed(link.dataset.recording))) link.remove();
      else if (link.textContent === wanted) {
        play(link);
        isThere = true;
      }
    }
    if (!isThere) {
      document.getElementById("replay-wanted").textContent = wanted;
      document.getElementById("replay-missing").hidden = false;
    }
  }
  begin();
})();
