// JSON as values that lose nothing: a number keeps its digits, an object is a Map, so that no key
// of a stranger's is special. What is too deep or too much is refused before it costs.

const DEPTH = 64
const VALUES = 20000 // in a message; a form of more would be slow

/** A number as it was written: 2^53 + 1 is none of JavaScript's. */
export class Num {
  constructor(text) {
    this.text = text
  }
}

const STRING = /"[^"\\]*(?:\\.[^"\\]*)*"/y
const NUMBER = /-?(?:0|[1-9]\d*)(?:\.\d+)?(?:[eE][+-]?\d+)?/y
const SPACE = /[ \t\r\n]*/y
const WORDS = [['true', true], ['false', false], ['null', null]]

/** The value of a JSON text of at most so many values. Throws SyntaxError, which says where. */
export function parse(text, most = VALUES) {
  return new Parser(text, most).whole()
}

class Parser {
  constructor(text, most) {
    this.text = text
    this.at = 0
    this.most = this.left = most
  }

  whole() {
    const value = this.value(0)
    if (this.next() !== '') this.fail('something follows the value')
    return value
  }

  fail(problem) {
    const before = this.text.slice(0, this.at).split('\n')
    throw new SyntaxError(`line ${before.length}, column ${before.at(-1).length + 1}: ${problem}`)
  }

  take(pattern) {
    pattern.lastIndex = this.at
    const found = pattern.exec(this.text)
    if (found === null) return null
    this.at = pattern.lastIndex
    return found[0]
  }

  /** The next character that is no white space, '' at the end. */
  next() {
    this.take(SPACE)
    return this.text[this.at] ?? ''
  }

  value(depth) {
    this.left -= 1
    if (this.left < 0) this.fail(`more than ${this.most} values`)
    if (depth > DEPTH) this.fail(`nested deeper than ${DEPTH} levels`)
    const first = this.next()
    if (first === '{') return this.object(depth)
    if (first === '[') return this.array(depth)
    if (first === '"') return this.string()
    for (const [word, value] of WORDS) {
      if (this.text.startsWith(word, this.at)) {
        this.at += word.length
        return value
      }
    }
    const number = this.take(NUMBER)
    if (number === null) this.fail(first === '' ? 'it ends too early' : 'a value is expected')
    return new Num(number)
  }

  string() {
    const begin = this.at
    const word = this.take(STRING)
    if (word === null) this.fail('a string does not end')
    try {
      return JSON.parse(word)
    } catch {
      this.at = begin
      return this.fail('a string with a line break or a wrong escape')
    }
  }

  object(depth) {
    const found = new Map()
    this.members('}', () => {
      if (this.next() !== '"') this.fail('the name of a field is expected, in double quotes')
      const name = this.string()
      if (this.next() !== ':') this.fail('a colon is expected')
      this.at += 1
      found.set(name, this.value(depth + 1))
    })
    return found
  }

  array(depth) {
    const found = []
    this.members(']', () => found.push(this.value(depth + 1)))
    return found
  }

  members(end, member) {
    this.at += 1
    if (this.next() === end) {
      this.at += 1
      return
    }
    for (;;) {
      member()
      const after = this.next()
      this.at += 1
      if (after === end) return
      if (after !== ',') {
        this.at -= 1
        this.fail(`a comma or ${end} is expected`)
      }
    }
  }
}

/** The JSON text of such a value, a line for each member of an object; `indent` is the present one. */
export function print(value, indent = '') {
  if (value instanceof Num) return value.text
  const more = `${indent}  `
  if (value instanceof Map) {
    if (value.size === 0) return '{}'
    const lines = [...value].map(([name, inner]) => `${more}${JSON.stringify(name)}: ${print(inner, more)}`)
    return `{\n${lines.join(',\n')}\n${indent}}`
  }
  if (!Array.isArray(value)) return JSON.stringify(value)
  if (value.every((item) => !(item instanceof Map) && !Array.isArray(item))) {
    return `[${value.map((item) => print(item)).join(', ')}]`
  }
  return `[\n${value.map((item) => more + print(item, more)).join(',\n')}\n${indent}]`
}
