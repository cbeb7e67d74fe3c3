// Blosc 1 frames (lz4, bytes or bits shuffled) and crc32c: all that hyperpaint's stores are packed with. Zarrita's own blosc
// is WebAssembly, 600 kB, which a page that may run no evaluated code would have to allow.

const HEADER = 16;
const MOST_BYTES = 2 ** 30; // of a chunk, as hyperpaint.io.store.reader

class DamagedError extends Error {}

// Return the bytes of a blosc frame; whatever does not fit raises, nothing is written past its end.
export function unblosc(frame) {
  const view = new DataView(frame.buffer, frame.byteOffset, frame.byteLength);
  if (frame.length < HEADER) throw new DamagedError("a chunk is no blosc frame");
  const flags = frame[2];
  const itemBytes = Math.max(1, frame[3]);
  const [size, blockSize, packedSize] = [4, 8, 12].map((at) => view.getUint32(at, true));
  if (packedSize !== frame.length || size > MOST_BYTES || (size && !blockSize)) throw new DamagedError("a chunk was cut short");
  if (flags & 2) return new Uint8Array(frame.subarray(HEADER, HEADER + size)); // stored as it is
  if (flags >> 5 !== 1) throw new Error("a chunk is packed otherwise than by blosc's lz4");
  const out = new Uint8Array(size);
  const block = new Uint8Array(Math.min(blockSize, size));
  for (let start = 0, number = 0; start < size; start += blockSize, number += 1) {
    const length = Math.min(blockSize, size - start);
    const isSplit = !(flags & 16) && length === blockSize && itemBytes <= 16 && blockSize / itemBytes >= 128;
    const streams = isSplit ? itemBytes : 1;
    const part = length / streams;
    let at = view.getInt32(HEADER + 4 * number, true);
    for (let stream = 0; stream < streams; stream += 1) {
      const packed = view.getInt32(at, true);
      at += 4;
      if (packed < 0 || at + packed > frame.length) throw new DamagedError("a chunk is damaged");
      const source = frame.subarray(at, at + packed);
      const target = block.subarray(stream * part, (stream + 1) * part);
      if (packed === part) target.set(source);
      else unlz4(source, target);
      at += packed;
    }
    const target = out.subarray(start, start + length);
    if (flags & 4) unshuffleBits(block, target, itemBytes);
    else if (flags & 1) unshuffleBytes(block, target, itemBytes);
    else target.set(block.subarray(0, length));
  }
  return out;
}

// Fill `target` from a block of lz4: literals, then a match further up, again and again.
function unlz4(source, target) {
  let [from, to] = [0, 0];
  const lengthOf = (nibble) => {
    let length = nibble;
    for (let byte = nibble === 15 ? 255 : 0; byte === 255; length += byte) byte = source[from++];
    return length;
  };
  while (from < source.length) {
    const token = source[from++];
    const literals = lengthOf(token >> 4);
    // NaN, of a length that runs past the end, is not below either
    if (!(literals <= source.length - from && literals <= target.length - to)) throw new DamagedError("a chunk is damaged");
    target.set(source.subarray(from, from + literals), to);
    from += literals;
    to += literals;
    if (from === source.length) break;
    const offset = source[from] | (source[from + 1] << 8);
    from += 2;
    const match = lengthOf(token & 15) + 4;
    if (!(offset > 0 && offset <= to && match <= target.length - to)) throw new DamagedError("a chunk is damaged");
    for (const end = to + match; to < end; to += 1) target[to] = target[to - offset];
  }
  if (to !== target.length) throw new DamagedError("a chunk is damaged");
}

// The first bytes of all items stand together, then the second ones; what makes no whole item stands last.
function unshuffleBytes(source, target, itemBytes) {
  const items = Math.floor(target.length / itemBytes);
  for (let byte = 0; byte < itemBytes; byte += 1)
    for (let item = 0; item < items; item += 1) target[item * itemBytes + byte] = source[byte * items + item];
  target.set(source.subarray(items * itemBytes, target.length), items * itemBytes);
}

// Row 8 b + k holds bit k of byte b of all items, eight items a byte: squares of 8 x 8 bits are turned over.
function unshuffleBits(source, target, itemBytes) {
  const items = Math.floor(target.length / itemBytes);
  if (items % 8) {
    target.set(source.subarray(0, target.length)); // as blosc leaves such a block
    return;
  }
  const row = items / 8;
  for (let byte = 0; byte < itemBytes; byte += 1) {
    for (let group = 0; group < row; group += 1) {
      const at = 8 * byte * row + group;
      let low = source[at] | (source[at + row] << 8) | (source[at + 2 * row] << 16) | (source[at + 3 * row] << 24);
      let high = source[at + 4 * row] | (source[at + 5 * row] << 8) | (source[at + 6 * row] << 16) | (source[at + 7 * row] << 24);
      // H. S. Warren, Hacker's Delight, section 7-3
      let swap = (low ^ (low >>> 7)) & 0x00aa00aa;
      low ^= swap ^ (swap << 7);
      swap = (high ^ (high >>> 7)) & 0x00aa00aa;
      high ^= swap ^ (swap << 7);
      swap = (low ^ (low >>> 14)) & 0x0000cccc;
      low ^= swap ^ (swap << 14);
      swap = (high ^ (high >>> 14)) & 0x0000cccc;
      high ^= swap ^ (swap << 14);
      swap = (low ^ (high << 4)) & 0xf0f0f0f0;
      low ^= swap;
      high ^= swap >>> 4;
      let to = 8 * group * itemBytes + byte;
      for (let bit = 0; bit < 32; bit += 8, to += itemBytes) target[to] = low >>> bit;
      for (let bit = 0; bit < 32; bit += 8, to += itemBytes) target[to] = high >>> bit;
    }
  }
  target.set(source.subarray(items * itemBytes, target.length), items * itemBytes);
}

const CRC32C = Uint32Array.from({ length: 256 }, (_, byte) => {
  let value = byte;
  for (let bit = 0; bit < 8; bit += 1) value = value & 1 ? (value >>> 1) ^ 0x82f63b78 : value >>> 1;
  return value;
});

// Return the bytes before a checksum, once it is theirs.
export function checked(bytes) {
  const body = bytes.subarray(0, bytes.length - 4);
  let value = 0xffffffff;
  for (const byte of body) value = CRC32C[(value ^ byte) & 255] ^ (value >>> 8);
  const expected = new DataView(bytes.buffer, bytes.byteOffset).getUint32(body.length, true);
  if ((value ^ 0xffffffff) >>> 0 !== expected) throw new DamagedError("a chunk is damaged: its checksum is another");
  return body;
}
