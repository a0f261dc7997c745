"use strict";
// The one renderer of a board: all pages draw by it. A cell is an index, counted row by row.

const element = (id) => document.getElementById(id);
const number = (value) => value.toLocaleString("en-US");
const rgb = (colour) => `rgb(${colour})`;
const INK = "#101216";
const IN_PLAY = 4, VIOLATED = 8;
/** The classes of cells in a window, see cprl.commons.cells. */
const CLASSES = {wall: 1, apple: 2, heading: 3, beam: 4, other: 5, self: 6, water: 8, waste: 9, cleaning: 10, agent: 11};
/** The free part at each side of a cell, of what does not fill it. */
const INSETS = {[CLASSES.apple]: .12, [CLASSES.heading]: .34, [CLASSES.beam]: .38, [CLASSES.cleaning]: .38};

/** Returns a new element with a text. */
function made(tag, parent, words = "", name = "") {
  const child = document.createElement(tag);
  child.textContent = words;
  if (name) child.className = name;
  parent.append(child);
  return child;
}

/** Returns a new canvas that a screen reader calls by its label. */
function madeCanvas(parent, label) {
  const canvas = made("canvas", parent);
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", label);
  return canvas;
}

/** Returns the bytes of a text in base64. */
const bytesOf = (text) => Uint8Array.from(atob(text), (sign) => sign.charCodeAt(0));

/** Returns the bits of a hexadecimal text, the highest of each digit first, as numbers 0 and 1. */
const bitsOf = (hex, count) =>
  Uint8Array.from({length: count}, (_, index) => parseInt(hex[index >> 2], 16) >> (3 - index % 4) & 1);

/** Returns what `drawBoard` takes of a turn, from what `moment_json` says of it. */
const momentOf = (scene, {apples, waste, ...others}) =>
  ({stock: bitsOf(apples, scene.sites.length), waste: bitsOf(waste, scene.river.length), ...others});

/** Unpacks what changes from turn to turn of a population: JSON that is deflated. */
async function unpack(population) {
  const stream = new Blob([bytesOf(population.data)]).stream().pipeThrough(new DecompressionStream("deflate"));
  Object.assign(population, JSON.parse(await new Response(stream).text()));
}

/** Returns the pen of a cleared canvas, and the size that it has on the screen in CSS pixels. */
function penOf(canvas) {
  const scale = devicePixelRatio || 1, box = canvas.getBoundingClientRect();
  const wide = Math.round(box.width * scale), high = Math.round(box.height * scale);
  if (canvas.width !== wide || canvas.height !== high) {
    canvas.width = wide;
    canvas.height = high;
  }
  const pen = canvas.getContext("2d");
  pen.setTransform(scale, 0, 0, scale, 0, 0);
  pen.clearRect(0, 0, box.width, box.height);
  return [pen, box.width, box.height];
}

/** Gives a canvas the form of so many cells. */
function fitBoard(canvas, columns, rows) {
  canvas.style.aspectRatio = `${columns} / ${rows}`;
}

/** Cells of a canvas, whose edges are whole pixels of the screen. */
class Cells {
  constructor(canvas, columns) {
    [this.pen, this.wide] = penOf(canvas);
    this.columns = columns;
    this.size = this.wide / columns;
    this.scale = devicePixelRatio || 1;
  }

  /** Returns a length as whole pixels of the screen. */
  whole(length) {
    return Math.round(length * this.scale) / this.scale;
  }

  /** Returns the left and upper edge of a cell. */
  corner(cell) {
    return [this.whole(cell % this.columns * this.size), this.whole(Math.floor(cell / this.columns) * this.size)];
  }

  /** Fills a cell, but for the part `inset` at each side. */
  square(cell, colour, inset = 0) {
    const [x, y] = this.corner(cell), edge = this.whole(inset * this.size);
    const right = this.whole((cell % this.columns + 1) * this.size);
    const bottom = this.whole((Math.floor(cell / this.columns) + 1) * this.size);
    this.pen.fillStyle = rgb(colour);
    this.pen.fillRect(x + edge, y + edge, right - x - 2 * edge, bottom - y - 2 * edge);
  }

  /** Draws a line around cells, at their inner side. */
  border(cells, colour, height) {
    const {pen, columns, size} = this, inside = new Set(cells);
    pen.strokeStyle = rgb(colour);
    pen.lineWidth = Math.max(1, size / 12);
    pen.lineCap = "square";
    pen.beginPath();
    for (const cell of inside) {
      const [x, y] = this.corner(cell), col = cell % columns, row = Math.floor(cell / columns);
      const isOut = (other, isOnBoard) => !(isOnBoard && inside.has(other));
      const above = isOut(cell - columns, row > 0), below = isOut(cell + columns, row < height - 1);
      const before = isOut(cell - 1, col > 0), after = isOut(cell + 1, col < columns - 1);
      const near = .06 * size, far = .94 * size;
      const left = x + (before ? near : 0), right = x + (after ? far : size);
      const top = y + (above ? near : 0), bottom = y + (below ? far : size);
      const sides = [[above, left, top, right, top], [below, left, bottom, right, bottom],
        [before, left, top, left, bottom], [after, right, top, right, bottom]];
      for (const [isBorder, fromX, fromY, toX, toY] of sides) {
        if (!isBorder) continue;
        pen.moveTo(fromX, fromY);
        pen.lineTo(toX, toY);
      }
    }
    pen.stroke();
  }

  /** Draws the diamond around an agent that broke a rule. */
  diamond(cell) {
    const {pen, size} = this, [x, y] = this.corner(cell), far = size * .75;
    pen.strokeStyle = "#fff";
    pen.lineWidth = Math.max(1.5, size / 9);
    pen.beginPath();
    for (const [right, down] of [[0, -far], [far, 0], [0, far], [-far, 0]]) {
      pen.lineTo(x + size / 2 + right, y + size / 2 + down);
    }
    pen.closePath();
    pen.stroke();
  }

  /** Draws a bright frame around a cell, apart from what is in it. */
  frame(cell) {
    const {pen, size} = this, [x, y] = this.corner(cell), wide = Math.max(2, size / 12);
    for (const [colour, out, width] of [[INK, .02, wide], ["#fff", .02 + wide / size, wide]]) {
      pen.strokeStyle = colour;
      pen.lineWidth = width;
      pen.strokeRect(x - out * size, y - out * size, size * (1 + 2 * out), size * (1 + 2 * out));
    }
  }

  /** Draws an agent: its hue, its mark, a triangle where it heads, 0 for up, and its label. */
  agent(cell, colour, heading, mark = "plain", label = "") {
    const {pen, size} = this, [x, y] = this.corner(cell), edge = size * .05, body = size - 2 * edge;
    pen.fillStyle = rgb(colour);
    pen.fillRect(x + edge, y + edge, body, body);
    pen.strokeStyle = "#fff";
    pen.lineWidth = size / 10;
    if (mark === "ring") pen.strokeRect(x + 2 * edge, y + 2 * edge, body - 2 * edge, body - 2 * edge);
    pen.save();
    pen.translate(x + size / 2, y + size / 2);
    pen.rotate(heading * Math.PI / 2);
    pen.fillStyle = "#fff";
    if (mark === "stripe") pen.fillRect(-body / 2, body * .4, body, body * .1);
    if (mark === "corners") {
      for (const [right, down] of [[-.5, -.5], [.3, -.5], [-.5, .3], [.3, .3]]) {
        pen.fillRect(right * body, down * body, body * .2, body * .2);
      }
    }
    pen.fillStyle = INK;
    pen.beginPath();
    pen.moveTo(0, -body * .48);
    pen.lineTo(body * .22, -body * .26);
    pen.lineTo(-body * .22, -body * .26);
    pen.fill();
    pen.restore();
    const [right, down] = [[0, 1], [-1, 0], [0, -1], [1, 0]][heading];
    this.label(cell, label, right * size * .1, size * .03 + down * size * .1);
  }

  /** Writes a short text into a cell. */
  label(cell, text, right = 0, down = 0) {
    const {pen, size} = this, [x, y] = this.corner(cell), share = String(text).length > 2 ? .4 : .55;
    pen.fillStyle = INK;
    pen.font = `700 ${size * share}px system-ui, sans-serif`;
    pen.textAlign = "center";
    pen.textBaseline = "middle";
    pen.fillText(text, x + size / 2 + right, y + size / 2 + down);
  }
}

/** Draws one moment of a scene; the agent `me` gets a bright frame. */
function drawBoard(canvas, scene, moment, me = -1) {
  const cells = new Cells(canvas, scene.width), paint = scene.palette, count = scene.width * scene.height;
  scene.walls.forEach((cell) => cells.square(cell, paint.wall));
  scene.river.forEach((cell, index) => cells.square(cell, moment.waste?.[index] ? paint.waste : paint.water));
  scene.sites.forEach((cell, index) =>
    cells.square(cell, moment.stock[index] ? paint.apple : paint.empty, INSETS[CLASSES.apple]));
  for (const region of scene.regions) cells.border(region.cells, region.colour, scene.height);
  for (const cell of moment.beams) {
    cells.square(cell % count, cell < count ? paint.beam : paint.cleaning, INSETS[CLASSES.beam]);
  }
  const agents = scene.colours.map((_, agent) => agent);
  for (const agent of agents) {
    if (!(moment.poses[agent] & IN_PLAY)) continue;
    const label = moment.labels?.[agent] ?? agent;
    cells.agent(moment.cells[agent], scene.colours[agent], moment.poses[agent] & 3, scene.marks[agent], label);
  }
  for (const agent of agents) {
    const isInPlay = moment.poses[agent] & IN_PLAY;
    if (isInPlay && (agent === me || moment.rings?.[agent])) cells.frame(moment.cells[agent]);
    if (moment.poses[agent] & VIOLATED) cells.diamond(moment.cells[agent]);
  }
}

/** Draws what an agent sees, {rows, columns, colours by class}, from the class of each cell; it heads up. */
function drawWindow(canvas, sight, classes) {
  const cells = new Cells(canvas, sight.columns);
  classes.forEach((kind, cell) => {
    const colour = sight.colours[kind];
    if (!kind || !colour) return;
    if (kind === CLASSES.self) {
      cells.agent(cell, colour, 0);
      return;
    }
    cells.square(cell, colour, INSETS[kind] ?? (kind === CLASSES.other || kind >= CLASSES.agent ? .05 : 0));
    if (kind >= CLASSES.agent) cells.label(cell, kind - CLASSES.agent, 0, cells.size * .03);
  });
}
