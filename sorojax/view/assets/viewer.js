"use strict";
// Draws the surfaces of one page with WebGL2. No library, no request but the stream of a live page.
(async function () {
  const get = (id) => document.getElementById(id);
  const meta = JSON.parse(get("meta").textContent);
  const canvas = get("view");
  const gl = canvas.getContext("webgl2", { antialias: true });
  function fail(text) {
    get("note").textContent = text;
    get("note").hidden = false;
  }
  if (!gl) return fail("This browser offers no WebGL 2, which the picture needs.");
  if (typeof DecompressionStream === "undefined")
    return fail("This browser has no DecompressionStream: take one from 2023 or later.");

  // ---- data -------------------------------------------------------------------------------
  function bytesOf(text) {
    const chars = atob(text);
    const bytes = new Uint8Array(chars.length);
    for (let k = 0; k < chars.length; k++) bytes[k] = chars.charCodeAt(k);
    return bytes;
  }
  async function inflate(bytes) {
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    return new Response(stream).arrayBuffer();
  }
  function unfold(raw, block) {
    const size = block.shape[1] * block.shape[2];
    const count = block.shape[0] * size;
    const low = new Uint8Array(raw, block.at, count);
    const high = new Uint8Array(raw, block.at + count, count);
    const out = new Int16Array(count);
    for (let k = 0; k < count; k++) {
      const folded = low[k] | (high[k] << 8);
      let value = (folded >>> 1) ^ -(folded & 1);
      const before = k >= size ? out[k - size] : 0;
      value += before;
      if (block.order === 2) value += before - (k >= 2 * size ? out[k - 2 * size] : 0);
      out[k] = value;
    }
    return Array.from({ length: block.shape[0] }, (_, f) => out.subarray(f * size, (f + 1) * size));
  }

  // ---- drawing ----------------------------------------------------------------------------
  const VERTEX = `#version 300 es
    in float x; in float y; in float z; in vec3 normal; in float value;
    uniform mat4 model, view, projection; uniform vec3 centre, extent; uniform vec2 span;
    out vec3 n; out vec3 at; out float share;
    void main() {
      vec4 eye = view * model * vec4(centre + extent * vec3(x, y, z), 1.0);
      n = mat3(view) * mat3(model) * normal;
      at = eye.xyz;
      share = span.x * value + span.y;
      gl_Position = projection * eye;
    }`;
  const FRAGMENT = `#version 300 es
    precision highp float;
    in vec3 n; in vec3 at; in float share;
    uniform vec3 colour, up; uniform float mapped, lit; uniform sampler2D ramp;
    out vec4 pixel;
    void main() {
      vec3 base = mapped > 0.5 ? texture(ramp, vec2(share, 0.5)).rgb : colour;
      if (lit < 0.5) { pixel = vec4(base, 1.0); return; }
      vec3 facet = normalize(cross(dFdx(at), dFdy(at)));
      vec3 s = dot(n, n) > 0.0 ? normalize(n) : facet;
      if (dot(facet, at) > 0.0) facet = -facet;
      if (dot(s, facet) < 0.0) s = -s;
      vec3 light = normalize(vec3(-0.45, 0.65, 0.75));
      float sky = 0.5 + 0.5 * dot(s, up);
      float shine = pow(max(dot(reflect(-light, s), normalize(-at)), 0.0), 24.0);
      vec3 shade = base * (0.44 + 0.24 * sky + 0.42 * max(dot(s, light), 0.0)) + 0.08 * shine;
      pixel = vec4(shade, 1.0);
    }`;
  function shader(kind, source) {
    const made = gl.createShader(kind);
    gl.shaderSource(made, source);
    gl.compileShader(made);
    if (!gl.getShaderParameter(made, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(made));
    return made;
  }
  const program = gl.createProgram();
  gl.attachShader(program, shader(gl.VERTEX_SHADER, VERTEX));
  gl.attachShader(program, shader(gl.FRAGMENT_SHADER, FRAGMENT));
  gl.linkProgram(program);
  gl.useProgram(program);
  const at = (name) => gl.getUniformLocation(program, name);
  const slot = (name) => gl.getAttribLocation(program, name);
  const U = {}, A = {};
  for (const name of ["model", "view", "projection", "centre", "extent", "span", "colour", "up",
    "mapped", "lit", "ramp"]) U[name] = at(name);
  for (const name of ["x", "y", "z", "normal", "value"]) A[name] = slot(name);

  function edgesOf(actor) {
    const { triangles, source, points } = actor, seen = new Set(), edges = [];
    for (let k = 0; k < triangles.length; k++) {
      const a = triangles[k], b = triangles[k % 3 === 2 ? k - 2 : k + 1];
      const key = Math.min(source[a], source[b]) * points + Math.max(source[a], source[b]);
      if (!seen.has(key)) { seen.add(key); edges.push(a, b); }
    }
    return new Uint32Array(edges);
  }
  function indices(numbers) {
    const buffer = gl.createBuffer();
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, numbers, gl.STATIC_DRAW);
    return buffer;
  }
  // Corners that meet at a sharp edge get points of their own: shading then keeps the edge.
  function split(rows, points, normals) {
    const root = Uint32Array.from(rows, (_, k) => k), halves = new Map();
    const find = (k) => {
      while (root[k] !== k) k = root[k] = root[root[k]];
      return k;
    };
    for (let k = 0; k < rows.length; k++) {
      const next = k % 3 === 2 ? k - 2 : k + 1, a = rows[k], b = rows[next];
      const key = Math.min(a, b) * points + Math.max(a, b);
      const other = halves.get(key);
      if (other === undefined) {
        halves.set(key, [k, next]);
        continue;
      }
      const m = 3 * Math.floor(k / 3), n = 3 * Math.floor(other[0] / 3);
      const aligned = normals[m] * normals[n] + normals[m + 1] * normals[n + 1] +
        normals[m + 2] * normals[n + 2];
      if (aligned < 0.8) continue;
      for (const mine of [k, next]) {
        const same = other.find((corner) => rows[corner] === rows[mine]);
        root[find(mine)] = find(same);
      }
    }
    const number = new Map(), source = [], triangles = new Uint32Array(rows.length);
    for (let k = 0; k < rows.length; k++) {
      const group = find(k);
      if (!number.has(group)) {
        number.set(group, source.length);
        source.push(rows[k]);
      }
      triangles[k] = number.get(group);
    }
    return { triangles, source: Uint32Array.from(source) };
  }
  function facets(rows, points, q, extent) {
    const found = new Float32Array(rows.length);
    const at = (i) => [0, 1, 2].map((j) => q[j * points + i] * extent[j]);
    for (let k = 0; k < rows.length; k += 3) {
      const [p, u, v] = [at(rows[k]), at(rows[k + 1]), at(rows[k + 2])];
      const a = u.map((x, j) => x - p[j]), b = v.map((x, j) => x - p[j]);
      const n = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
      const size = Math.hypot(...n) || 1;
      for (let j = 0; j < 3; j++) found[k + j] = n[j] / size;
    }
    return found;
  }
  function spread(actor, data, columns) {
    const { source, points } = actor, n = source.length, out = new Int16Array(columns * n);
    for (let j = 0; j < columns; j++)
      for (let i = 0; i < n; i++) out[j * n + i] = data[j * points + source[i]];
    return out;
  }
  function prepare(raw, info) {
    const rows = new Uint32Array(raw, info.triangles.at, info.triangles.count);
    const frames = unfold(raw, info.points), points = info.points.shape[2];
    const extent = info.low.map((low, k) => Math.max((info.high[k] - low) / 2, 1e-30));
    const { triangles, source } = split(rows, points, facets(rows, points, frames[0], extent));
    return {
      info, triangles, source, frames, points, extent, drawn: -1,
      values: info.values && unfold(raw, info.values),
      poses: info.poses && new Float32Array(raw, info.poses.at, info.poses.count),
      faces: indices(triangles), edges: null,
      places: gl.createBuffer(), normals: gl.createBuffer(), colours: gl.createBuffer(),
      centre: info.low.map((low, k) => (low + info.high[k]) / 2),
    };
  }
  function normalsOf(actor, q) {
    const n = actor.source.length, t = actor.triangles, sum = new Float32Array(3 * n);
    const [sx, sy, sz] = actor.extent.map((e) => e / 32767);
    for (let k = 0; k < t.length; k += 3) {
      const a = t[k], b = t[k + 1], c = t[k + 2];
      const ux = (q[b] - q[a]) * sx, uy = (q[n + b] - q[n + a]) * sy;
      const uz = (q[2 * n + b] - q[2 * n + a]) * sz;
      const vx = (q[c] - q[a]) * sx, vy = (q[n + c] - q[n + a]) * sy;
      const vz = (q[2 * n + c] - q[2 * n + a]) * sz;
      const nx = uy * vz - uz * vy, ny = uz * vx - ux * vz, nz = ux * vy - uy * vx;
      for (const i of [a, b, c]) { sum[3 * i] += nx; sum[3 * i + 1] += ny; sum[3 * i + 2] += nz; }
    }
    const packed = new Int8Array(4 * n);
    for (let i = 0; i < n; i++) {
      const size = Math.hypot(sum[3 * i], sum[3 * i + 1], sum[3 * i + 2]) || 1;
      for (let j = 0; j < 3; j++) packed[4 * i + j] = Math.round((127 * sum[3 * i + j]) / size);
    }
    return packed;
  }
  function fill(buffer, data) {
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
  }
  const pick = (frames, k) => frames[Math.min(k, frames.length - 1)];
  function upload(actor, k) {
    if (actor.drawn < 0 || actor.frames.length > 1) {
      const q = spread(actor, pick(actor.frames, k), 3);
      fill(actor.places, q);
      fill(actor.normals, normalsOf(actor, q));
    }
    if (actor.values) fill(actor.colours, spread(actor, pick(actor.values, k), 1));
    actor.drawn = k;
  }
  function attribute(name, buffer, size, kind, stride, offset) {
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.enableVertexAttribArray(A[name]);
    gl.vertexAttribPointer(A[name], size, kind, true, stride, offset);
  }
  const UNIT = new Float32Array([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]);
  function draw(actor, k) {
    if (actor.drawn !== k) upload(actor, k);
    attribute("x", actor.places, 1, gl.SHORT, 2, 0);
    attribute("y", actor.places, 1, gl.SHORT, 2, 2 * actor.source.length);
    attribute("z", actor.places, 1, gl.SHORT, 2, 4 * actor.source.length);
    attribute("normal", actor.normals, 3, gl.BYTE, 4, 0);
    if (actor.values) attribute("value", actor.colours, 1, gl.SHORT, 2, 0);
    else gl.disableVertexAttribArray(A.value);
    const last = actor.poses ? actor.poses.length / 16 - 1 : 0, row = 16 * Math.min(k, last);
    gl.uniformMatrix4fv(U.model, false, actor.poses ? actor.poses.subarray(row, row + 16) : UNIT);
    gl.uniform3fv(U.centre, actor.centre);
    gl.uniform3fv(U.extent, actor.extent);
    gl.uniform2f(U.span, 32767 / (2 * meta.levels), 0.5);
    gl.uniform3fv(U.colour, actor.info.colour);
    gl.uniform1f(U.mapped, actor.values ? 1 : 0);
    gl.uniform1f(U.lit, 1);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, actor.faces);
    gl.drawElements(gl.TRIANGLES, actor.triangles.length, gl.UNSIGNED_INT, 0);
    if (!get("wire").checked) return;
    if (!actor.edges) {
      const edges = edgesOf(actor);
      actor.edges = { buffer: indices(edges), count: edges.length };
    }
    gl.uniform3f(U.colour, 0.12, 0.14, 0.19);
    gl.uniform1f(U.mapped, 0);
    gl.uniform1f(U.lit, 0);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, actor.edges.buffer);
    gl.drawElements(gl.LINES, actor.edges.count, gl.UNSIGNED_INT, 0);
  }
  function ramp() {
    const pixels = new Uint8Array(meta.ramp.flatMap((c) => [...c, 255]));
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, meta.ramp.length, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE,
      pixels);
    for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T])
      gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
    gl.uniform1i(U.ramp, 0);
    if (!meta.label) return;
    const stops = meta.ramp.map((c) => `rgb(${c})`).join(",");
    get("ramp").style.background = `linear-gradient(to top, ${stops})`;
    get("name").textContent = meta.label;
    const [low, high] = meta.limits, ticks = get("ticks");
    for (const share of [1, 0.75, 0.5, 0.25, 0]) {
      const tick = document.createElement("span");
      tick.textContent = Number((low + share * (high - low)).toPrecision(3)).toString();
      ticks.append(tick);
    }
    get("bar").hidden = false;
  }
