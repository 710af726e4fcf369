// What a JSON Schema of the bridge says about a field, and what is wrong with a value by it. The
// schema is a text from the network: it may be recursive, huge, or none at all.

import { Num, parse, print } from './exact.js'

const HOPS = 16 // references one after the other
const ERRORS = 100
const CONSTANTS = 200 // of a field
const LARGEST = 100000 // values of a schema
const NESTED = 16 // levels that are filled in
const FILLED = 1000 // items that are filled in, in all

/** The schema of a text; null where it is none. */
export function schemaOf(text) {
  try {
    const found = parse(text, LARGEST)
    return found instanceof Map ? found : null
  } catch {
    return null
  }
}

/**
 * What a part of the schema takes: its `kind`, and by that what belongs to it.
 * object: fields (Map of name → part), constants (Map of name → value); array: item, least, most; octets: least, most;
 * integer: low, high (BigInt or null); string: most; choice: values; and number, boolean, any.
 * `isTime` says that "now" is taken too, `preset` is the default, undefined without one.
 */
export function describe(root, part) {
  let found = part
  let isTime = false
  let preset
  for (let hop = 0; hop < HOPS && found instanceof Map; hop++) {
    if (preset === undefined && found.has('default')) preset = found.get('default')
    const options = listOf(found, 'anyOf') ?? listOf(found, 'oneOf')
    if (typeof found.get('$ref') === 'string') {
      found = definition(root, found.get('$ref'))
    } else if (options !== null) {
      const rest = options.filter((option) => !isNow(option))
      isTime ||= rest.length < options.length
      if (rest.length && rest.every((option) => option instanceof Map && option.has('const'))) {
        return { kind: 'choice', values: rest.map((option) => option.get('const')), isTime, preset }
      }
      const isOctets = rest.some((option) => option instanceof Map && option.get('contentEncoding') === 'base64')
      const array = isOctets && rest.find((option) => option instanceof Map && option.get('type') === 'array')
      if (array) return { kind: 'octets', ...bounds(array), isTime, preset }
      if (rest.length !== 1) break
      ;[found] = rest
    } else {
      return { ...plain(found), isTime, preset }
    }
  }
  return { kind: 'any', isTime, preset }
}

function plain(part) {
  const values = listOf(part, 'enum')
  if (values !== null) return { kind: 'choice', values }
  if (part.has('const')) return { kind: 'choice', values: [part.get('const')] }
  const type = [part.get('type')].flat().find((name) => name !== 'null')
  if (type === 'object') {
    const fields = part.get('properties')
    const constants = part.get('x-constants')
    return fields instanceof Map ? { kind: 'object', fields, constants: constants instanceof Map ? constants : new Map() } : { kind: 'any' }
  }
  if (type === 'array') return { kind: 'array', item: part.get('items'), ...bounds(part) }
  if (type === 'integer') return { kind: 'integer', low: integerOf(part.get('minimum')), high: integerOf(part.get('maximum')) }
  if (type === 'string') return { kind: 'string', most: countOf(part.get('maxLength')) }
  return { kind: type === 'number' || type === 'boolean' ? type : 'any' }
}

function listOf(part, name) {
  const found = part.get(name)
  return Array.isArray(found) && found.length ? found : null
}

function isNow(option) {
  return option instanceof Map && option.get('const') === 'now'
}

function definition(root, reference) {
  let found = root
  for (const step of reference.split('/').slice(1)) {
    if (!(found instanceof Map)) return undefined
    found = found.get(step.replaceAll('~1', '/').replaceAll('~0', '~'))
  }
  return found
}

function bounds(part) {
  return { least: countOf(part.get('minItems')) ?? 0, most: countOf(part.get('maxItems')) }
}

function countOf(value) {
  const found = value instanceof Num ? Number(value.text) : NaN
  return Number.isSafeInteger(found) && found >= 0 ? found : null
}

/** The constants that are meant for a field, as ROS's types name them: [name, text] each. */
export function constantsOf({ constants }, field) {
  const beginning = `${field}_`.toUpperCase()
  const found = [...constants].filter(([name, value]) => name.startsWith(beginning) && (value instanceof Num || typeof value === 'string'))
  return found.slice(0, CONSTANTS).map(([name, value]) => [name, value instanceof Num ? value.text : value])
}

/** The integer of a number's text, null where it is none or has too many digits for any. */
function integerOf(value) {
  return value instanceof Num && /^-?\d{1,25}$/.test(value.text) ? BigInt(value.text) : null
}

/** A first value for a part, for a new item of an array. */
export function initial(root, part, depth = 0, budget = { left: FILLED }) {
  const { kind, preset, item, least, low, high, values } = describe(root, part)
  if (preset !== undefined) return preset
  if (kind === 'object') return new Map()
  if (kind === 'array' && depth < NESTED) {
    const count = Math.min(least, budget.left)
    budget.left -= count
    return Array.from({ length: count }, () => initial(root, item, depth + 1, budget))
  }
  if (kind === 'octets') return btoa('\0'.repeat(Math.min(least, FILLED)))
  if (kind === 'integer') return new Num(String(low !== null && low > 0n ? low : high !== null && high < 0n ? high : 0))
  if (kind === 'number') return new Num('0')
  if (kind === 'choice') return values[0]
  return { array: [], string: '', boolean: false }[kind] ?? null
}

/** What is wrong with a value: [path, words] each, paths as the bridge names fields. */
export function check(root, value) {
  const found = []
  inspect(root, root, value, '', found)
  return found
}

function inspect(root, part, value, path, found) {
  if (found.length >= ERRORS) return
  const wanted = describe(root, part)
  const wrong = (words) => found.push([path, words])
  if (wanted.isTime && value === 'now') return
  if (wanted.kind === 'object') {
    if (!(value instanceof Map)) wrong(`expected an object, got ${named(value)}`)
    else for (const [name, inner] of value) {
      const below = path ? `${path}.${name}` : name
      if (wanted.fields.has(name)) inspect(root, wanted.fields.get(name), inner, below, found)
      else found.push([below, 'unknown field'])
    }
  } else if (wanted.kind === 'array' || (wanted.kind === 'octets' && Array.isArray(value))) {
    if (!Array.isArray(value)) return void wrong(`expected an array, got ${named(value)}`)
    counted(value.length, wanted, wrong)
    if (wanted.kind === 'octets') value.forEach((item, index) => octet(item, `${path}[${index}]`, found))
    else value.forEach((item, index) => inspect(root, wanted.item, item, `${path}[${index}]`, found))
  } else {
    SCALARS[wanted.kind]?.(value, wanted, wrong)
  }
}

const SCALARS = {
  octets(value, wanted, wrong) {
    if (typeof value !== 'string') return wrong(`expected base64 or an array, got ${named(value)}`)
    try {
      counted(atob(/\s/.test(value) || value.length % 4 ? '!' : value).length, wanted, wrong)
    } catch {
      wrong(`not base64: ${named(value)}`)
    }
    return undefined
  },
  integer(value, { low, high }, wrong) {
    if (!(value instanceof Num) || !/^-?\d+$/.test(value.text)) return wrong(`expected an integer, got ${named(value)}`)
    const number = integerOf(value)
    if (number === null || (low !== null && number < low) || (high !== null && number > high)) {
      wrong(`${named(value)} is not within ${low ?? '…'} to ${high ?? '…'}`)
    }
    return undefined
  },
  number(value, wanted, wrong) {
    if (value === null) return // NaN
    if (!(value instanceof Num)) wrong(`expected a number, got ${named(value)}`)
    else if (!Number.isFinite(Number(value.text))) wrong('too large: JSON has no infinity; null is NaN')
  },
  string(value, { most }, wrong) {
    if (typeof value !== 'string') wrong(`expected a string, got ${named(value)}`)
    else if (most !== null && [...value].length > most) wrong(`${[...value].length} characters, at most ${most} are allowed`)
  },
  boolean(value, wanted, wrong) {
    if (typeof value !== 'boolean') wrong(`expected true or false, got ${named(value)}`)
  },
  choice(value, { values }, wrong) {
    const texts = values.slice(0, 100).map((each) => print(each))
    if (!texts.includes(print(value))) wrong(`expected one of ${texts.slice(0, 10).join(', ')}`)
  },
}

function octet(value, path, found) {
  const number = integerOf(value)
  if (found.length < ERRORS && (number === null || number < 0n || number > 255n)) {
    found.push([path, `expected an integer from 0 to 255, got ${named(value)}`])
  }
}

function counted(count, { least, most }, wrong) {
  if (least === most && count !== least) wrong(`${count} items, exactly ${least} are expected`)
  else if (count < least) wrong(`${count} items, at least ${least} are expected`)
  else if (most !== null && count > most) wrong(`${count} items, at most ${most} are allowed`)
}

function named(value) {
  if (value instanceof Map) return 'an object'
  if (Array.isArray(value)) return 'an array'
  const text = print(value)
  return text.length > 40 ? `${text.slice(0, 40)}…` : text
}
