// As much of a browser as the viewer's page asks for. It draws once, and tells what was drawn.
const drawn = { fillRect: 0, arc: 0, lineTo: 0, text: [] };
const counted = name => () => { if (name in drawn) drawn[name] += 1; };
const canvas = new Proxy({}, {
  get: (_, name) => name === "fillText" ? text => drawn.text.push(text) : counted(name),
  set: () => true,
});
const element = () => ({
  style: {}, className: "", textContent: "", children: [], clientWidth: 400, clientHeight: 200,
  getContext: () => canvas,
  addEventListener() {},
  append(...more) { this.children.push(...more); },
  replaceChildren(...all) { this.children = all; },
});
const page = { scene: element(), say: element(), legend: element() };
globalThis.document = { getElementById: name => page[name], createElement: element };
globalThis.addEventListener = () => {};
globalThis.devicePixelRatio = 2;
globalThis.setTimeout = () => {};
globalThis.fetch = async name => ({ json: async () => answers[name] });
globalThis.requestAnimationFrame = draw => setImmediate(() => {
  draw();
  const status = page.say.children.map(one => [one.className, one.textContent]);
  process.stdout.write(JSON.stringify({ ...drawn, status, legend: page.legend.children.length }));
});
