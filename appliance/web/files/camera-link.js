// Pictures of one topic, decoded one at a time when the page asks for the next; the newest is kept,
// and one that comes while another is decoded takes the place of the one before.

import { checkedPicture, pictureType } from './pictures.js'
import { field, textAt, unpacked, valueOf } from './values.js'
import { Watch } from './watch-link.js'
import { contentType } from './formats.js'

export default class Camera {
  constructor(open, { topic, rate }) {
    this.newest = null
    this.skipped = 0
    this.watch = new Watch(open, [[topic, rate]], (_, payload, properties, at) => {
      if (this.newest !== null) this.skipped += 1
      this.newest = { payload, properties, at }
    })
  }

  stop() {
    this.watch.stop()
  }

  /** The next picture, or what has become of the connection; null when it is over. */
  async next() {
    if (!await this.watch.news()) return null
    const { newest, watch, skipped } = this
    this.newest = null
    const told = { reason: watch.reason, skipped, problem: '' }
    if (newest === null) return told
    Object.assign(told, { at: newest.at, size: newest.payload.length })
    try {
      const picture = checkedPicture(await pictureIn(newest.payload, newest.properties))
      told.bitmap = await createImageBitmap(picture).catch(() => { throw new Error(`${picture.type} that cannot be read`) })
    } catch (error) {
      told.problem = String(error.message).slice(0, 200)
    }
    return told
  }
}

/** The bytes of the picture in a payload. Raises an Error that says why there are none. */
export async function pictureIn(payload, properties) {
  const bytes = await unpacked(payload, properties)
  const type = contentType(properties)
  if (bytes.length === 0) throw new Error('an empty payload')
  if (pictureType(bytes)) return bytes
  if (type === 'application/cdr') return dataOfCdr(bytes)
  if (type && !type.endsWith('json') && type !== 'application/cbor') throw new Error(`${type}, and no picture`)
  const value = await valueOf(bytes, { contentType: type })
  const data = field(value, 'data')
  if (field(value, 'step') !== undefined) {
    throw new Error(`pixels as they are (${textAt(value, 'encoding')}): the route needs encoding: jpeg`)
  }
  const found = typeof data === 'string' ? bytesOfBase64(data) : data
  if (!(found instanceof Uint8Array)) throw new Error('a message without a picture in its field data')
  if (!pictureType(found)) throw new Error(`${textAt(value, 'format') || 'data'}, and not JPEG, PNG or WebP`)
  return found
}

function bytesOfBase64(text) {
  let binary
  try {
    binary = atob(text)
  } catch {
    throw new Error('data that is not base64')
  }
  return Uint8Array.from(binary, (char) => char.charCodeAt(0))
}

/** The field data of a sensor_msgs/CompressedImage in CDR: header, format, data. */
function dataOfCdr(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength)
  const isLittle = (bytes[1] & 1) === 1
  let at = 12 // behind CDR's header and the stamp
  const block = () => {
    at += (4 - (at % 4)) % 4
    const length = view.getUint32(at, isLittle)
    at += 4 + length
    if (at > bytes.length) throw new RangeError()
    return bytes.subarray(at - length, at)
  }
  try {
    block() // frame_id
    block() // format
    const data = block()
    if (pictureType(data)) return data
  } catch (error) {
    if (!(error instanceof RangeError)) throw error
  }
  throw new Error('CDR, and no CompressedImage of JPEG, PNG or WebP')
}
