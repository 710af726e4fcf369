// What kind of picture bytes are, and how large it will be, before it is decoded: a few bytes can
// stand for gigabytes of pixels.

export const MOST_PIXELS = 32 * 1024 * 1024 // 4 bytes each when they are decoded

/** The content type, by the first bytes; empty for what is none of the pictures that are shown. */
export function pictureType(bytes) {
  if (bytes[0] === 0xff && bytes[1] === 0xd8 && bytes[2] === 0xff) return 'image/jpeg'
  if (bytes[0] === 0x89 && word(bytes, 1, 3) === 'PNG') return 'image/png'
  if (word(bytes, 0, 4) === 'RIFF' && word(bytes, 8, 4) === 'WEBP') return 'image/webp'
  return ''
}

/** The picture for a decoder. Raises an Error that says why it is not shown. */
export function checkedPicture(bytes) {
  const type = pictureType(bytes)
  if (!type) throw new Error('neither JPEG nor PNG nor WebP')
  const [width, height] = SIZES[type](bytes) ?? [0, 0]
  if (!width || !height) throw new Error(`${type} without a size`)
  if (width * height > MOST_PIXELS) {
    throw new Error(`${width} × ${height} pixels: at most ${MOST_PIXELS} are shown`)
  }
  return new Blob([bytes], { type })
}

const SIZES = { 'image/jpeg': jpegSize, 'image/png': pngSize, 'image/webp': webpSize }

/** By the frame header among the segments (ITU-T T.81, B.2.2). */
function jpegSize(bytes) {
  let at = 2
  while (at + 9 < bytes.length && bytes[at] === 0xff) {
    const marker = bytes[at + 1]
    if (marker === 0xff) at += 1 // fill
    else if (marker >= 0xc0 && marker <= 0xcf && ![0xc4, 0xc8, 0xcc].includes(marker)) {
      return [bytes[at + 7] * 256 + bytes[at + 8], bytes[at + 5] * 256 + bytes[at + 6]]
    } else at += 2 + bytes[at + 2] * 256 + bytes[at + 3]
  }
  return null
}

function pngSize(bytes) {
  if (bytes.length < 24 || word(bytes, 12, 4) !== 'IHDR') return null
  const view = new DataView(bytes.buffer, bytes.byteOffset)
  return [view.getUint32(16), view.getUint32(20)]
}

/** The three kinds of WebP (RFC 9649, section 2). */
function webpSize(bytes) {
  if (bytes.length < 30) return null
  const little = (at, count) => {
    let found = 0
    for (let each = count - 1; each >= 0; each--) found = found * 256 + bytes[at + each]
    return found
  }
  const kind = word(bytes, 12, 4)
  if (kind === 'VP8X') return [1 + little(24, 3), 1 + little(27, 3)]
  if (kind === 'VP8 ') return [little(26, 2) & 0x3fff, little(28, 2) & 0x3fff]
  if (kind === 'VP8L') return [1 + (little(21, 2) & 0x3fff), 1 + ((little(22, 3) >> 6) & 0x3fff)]
  return null
}

function word(bytes, at, length) {
  return String.fromCharCode(...bytes.subarray(at, at + length))
}
