// The payload of the page, as columns.py packs it: a head, and columns of numbers by name.

async function readPayload(text) {
  const letters = atob(text.trim());
  const bytes = new Uint8Array(letters.length);
  for (let k = 0; k < letters.length; k++) bytes[k] = letters.charCodeAt(k);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream('deflate'));
  const body = new Uint8Array(await new Response(stream).arrayBuffer());
  const length = new DataView(body.buffer).getUint32(0, true);
  const head = JSON.parse(new TextDecoder().decode(body.subarray(4, 4 + length)));
  const columns = {};
  let at = 4 + length;
  for (const [name, size, rows, width, step, difference] of head.columns) {
    const count = rows * width * size;
    columns[name] = {
      rows, width, values: unpackColumn(body.subarray(at, at + count), size, rows, width, step, difference),
    };
    at += count;
  }
  return { head, columns };
}

// Rows by width, in units: byte b of number k is at b * n + k, numbers one component after the other.
function unpackColumn(raw, size, rows, width, step, difference) {
  const n = rows * width, values = new Float64Array(n);
  const whole = new Int32Array(1), real = new Float32Array(whole.buffer);
  const shift = 32 - 8 * size;
  for (let k = 0; k < n; k++) {
    let word = 0;
    for (let b = 0; b < size; b++) word |= raw[b * n + k] << (8 * b);
    whole[0] = (word << shift) >> shift;
    const row = k % rows, component = (k - row) / rows;
    values[row * width + component] = step === 0 ? real[0] : whole[0];
  }
  if (step === 0) return values;
  if (difference === 'rows') for (let k = width; k < n; k++) values[k] += values[k - width];
  if (difference === 'pairs') {
    for (let k = 0; k < n; k++) if (k % width >= 2) values[k] += values[k - 2];
  }
  if (step !== 1) for (let k = 0; k < n; k++) values[k] *= step;
  return values;
}
