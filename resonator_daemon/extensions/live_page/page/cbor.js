// CBOR (RFC 8949) as the array topics use it: maps, text, numbers, and float32 arrays of RFC 8746.

const TEXT = new TextDecoder();

/** Decode one CBOR item. Arrays of tag 40 become {shape, values: Float32Array}; 64-bit integers become BigInt. */
export function decodeCbor(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  let at = 0;

  function argument(info) {
    if (info < 24) return info;
    const start = at;
    if (info === 24) return (at += 1), view.getUint8(start);
    if (info === 25) return (at += 2), view.getUint16(start);
    if (info === 26) return (at += 4), view.getUint32(start);
    if (info === 27) return (at += 8), view.getBigUint64(start);
    throw new RangeError(`CBOR length ${info} is not supported`);
  }

  function size(info) {
    const count = Number(argument(info));
    if (count > bytes.byteLength - at) throw new RangeError("CBOR item is cut off");
    return count;
  }

  function half(bits) {
    const exponent = (bits >> 10) & 31;
    const fraction = bits & 1023;
    const sign = bits & 32768 ? -1 : 1;
    if (exponent === 31) return fraction ? NaN : sign * Infinity;
    return sign * (exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : 2 ** -14 * (fraction / 1024));
  }

  function simple(info) {
    const start = at;
    if (info === 20 || info === 21) return info === 21;
    if (info === 25) return (at += 2), half(view.getUint16(start));
    if (info === 26) return (at += 4), view.getFloat32(start);
    if (info === 27) return (at += 8), view.getFloat64(start);
    return null;
  }

  function tagged(tag) {
    const value = item();
    if (tag === 85) {
      // The copy is aligned and does not keep the whole message alive.
      return new Float32Array(value.slice().buffer);
    }
    if (tag === 40) return { shape: value[0].map(Number), values: value[1] };
    return value;
  }

  function item() {
    const first = view.getUint8(at++);
    const info = first & 31;
    switch (first >> 5) {
      case 0:
        return argument(info);
      case 1: {
        const value = argument(info);
        return typeof value === "bigint" ? -1n - value : -1 - value;
      }
      case 2: {
        const length = size(info);
        return (at += length), bytes.subarray(at - length, at);
      }
      case 3: {
        const length = size(info);
        return (at += length), TEXT.decode(bytes.subarray(at - length, at));
      }
      case 4: {
        const values = [];
        for (let left = size(info); left > 0; left--) values.push(item());
        return values;
      }
      case 5: {
        const map = {};
        for (let left = size(info); left > 0; left--) {
          const key = item();
          map[key] = item();
        }
        return map;
      }
      case 6:
        return tagged(Number(argument(info)));
      default:
        return simple(info);
    }
  }

  return item();
}
