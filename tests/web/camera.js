// node camera.js URL-of-the-console's-files: pictures in payloads, and how large they are.

import assert from 'node:assert/strict'

const { MOST_PIXELS, checkedPicture, pictureType } = await import(`${process.argv[2]}/pictures.js`)
const { pictureIn } = await import(`${process.argv[2]}/camera-link.js`)
const bytes = (text) => new TextEncoder().encode(text)
const hex = (text) => Uint8Array.from(Buffer.from(text.replaceAll(' ', ''), 'hex'))
const fails = (words) => (error) => { assert.match(error.message, words); return true }

const png = (width, height) => hex(`89504e470d0a1a0a 0000000d 49484452 ${width.toString(16).padStart(8, '0')} ${height.toString(16).padStart(8, '0')} 0802000000`)
const word = (value) => value.toString(16).padStart(4, '0')
const jpeg = (width, height, before = '') => hex(`ffd8 ffe0 0004 0000 ${before} ff c0 0011 08 ${word(height)} ${word(width)} 03 012200`)
const riff = (rest) => hex(`52494646 20000000 57454250 ${rest}${'00'.repeat(20)}`)

// What is a picture, and its size before it is decoded.
for (const picture of [
  png(640, 480), jpeg(640, 480), jpeg(640, 480, 'ffff ffc4 0002'),
  riff('56503820 10000000 000000 9d012a 8002 e001'), riff('5650384c 10000000 2f 7fc27700'), riff('56503858 0a000000 00000000 7f0200 df0100'),
]) {
  assert.equal(checkedPicture(picture).size, picture.length)
}
for (const [bomb, size] of [
  [png(30000, 20000), '30000 × 20000'], [png(0xffffffff, 0xffffffff), '4294967295 × 4294967295'], [jpeg(65500, 65000), '65500 × 65000'],
  [riff('56503820 10000000 000000 9d012a ff3f fe3f'), '16383 × 16382'], [riff('5650384c 10000000 2f fffffe0f'), '16384 × 16380'],
  [riff('56503858 0a000000 00000000 ffff01 ff7f00'), '131072 × 32768'],
]) {
  assert.throws(() => checkedPicture(bomb), fails(new RegExp(`^${size} pixels: at most ${MOST_PIXELS}`)))
}
for (const bad of [
  png(0, 5), png(5, 5).subarray(0, 20), jpeg(5, 0), jpeg(5, 5).subarray(0, 12), hex('ffd8ff'), hex('ffd8ffe00000'.padEnd(40000, '0')),
  riff('41424344'), riff('').subarray(0, 14),
]) {
  assert.throws(() => checkedPicture(bad), fails(/without a size/))
}
for (const other of [new Uint8Array(0), bytes('<svg onload="alert(1)"/>'), bytes('GIF89a'), hex('89'), hex('ff')]) {
  assert.equal(pictureType(other), '')
  assert.throws(() => checkedPicture(other), fails(/neither/))
}

// Where it is in what a route gives.
const picture = jpeg(640, 480)
const type = (contentType) => ({ contentType })
const same = async (payload, properties) => assert.deepEqual(Buffer.from(await pictureIn(payload, properties)), Buffer.from(picture))
await same(picture, type('image/jpeg'))
await same(picture, {})
await same(picture, type('application/octet-stream'))
const message = (data) => bytes(JSON.stringify({ header: { stamp: { sec: 1, nanosec: 2 }, frame_id: 'camera' }, format: 'jpeg', data }))
await same(message(Buffer.from(picture).toString('base64')), type('application/json; charset=utf-8'))
const length = word(picture.length)
const content = Buffer.from(picture).toString('hex')
await same(hex(`a2 66666f726d6174 646a706567 6464617461 59${length}${content}`), type('application/cbor'))
await same(hex(`a1 6464617461 d840 59${length}${content}`), type('application/cbor'))
const cdr = (frame, format) => {
  const text = (value) => {
    const body = Buffer.alloc(Math.ceil((value.length + 1) / 4) * 4)
    body.write(value)
    const head = Buffer.alloc(4)
    head.writeUInt32LE(value.length + 1)
    return Buffer.concat([head, body])
  }
  const head = Buffer.alloc(4)
  head.writeUInt32LE(picture.length)
  return new Uint8Array(Buffer.concat([hex('00010000 0100000002000000'), text(frame), text(format), head, picture]))
}
for (const frame of ['', 'a', 'ab', 'abc', 'camera_link']) await same(cdr(frame, 'rgb8; jpeg compressed'), type('application/cdr'))

// And where there is none, in words.
const none = (payload, properties, words) => assert.rejects(pictureIn(payload, properties), fails(words))
await none(new Uint8Array(0), type('image/jpeg'), /empty/)
await none(bytes('no picture'), type('image/jpeg'), /image\/jpeg, and no picture/)
await none(bytes('<svg/>'), type('image/svg+xml'), /no picture/)
await none(message('!'), type('application/json'), /base64/)
await none(message(''), type('application/json'), /jpeg, and not/)
await none(message(17), type('application/json'), /without a picture/)
await none(message({ __proto__: null, length: 1e9 }), type('application/json'), /without a picture/)
await none(bytes('null'), type('application/json'), /without a picture/)
await none(bytes('{"encoding": "rgb8", "step": 3, "data": ""}'), type('application/json'), /rgb8.*encoding: jpeg/)
await none(bytes('[[[['), type('application/json'), /JSON/)
await none(hex('9bffffffffffffffff'), type('application/cbor'), /./)
await none(new Uint8Array(1e6).fill(0x81), type('application/cbor'), /./)
for (const cut of [5, 12, 20, 40, -4]) await none(cdr('camera', 'jpeg').slice(0, cut), type('application/cdr'), /CDR/)
await none(new Uint8Array(100).fill(0xff), type('application/cdr'), /CDR/)
console.log('ok')
