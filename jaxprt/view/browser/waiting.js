// What the page waits for, in words.

const LONG_WAIT = 400; // milliseconds from which on an answer is waited for in words

// The texts of all that is waited for; `show` gets the newest, and the share of it that is done, null if nobody knows.
export class Waiting {
  constructor(show) {
    this.show = show;
    this.texts = new Map();
  }
  set(name, text, share = null) {
    this.texts.delete(name);
    if (text) this.texts.set(name, [text, share]);
    this.show(...([...this.texts.values()].pop() ?? ["", null]));
  }
  // Waits for a promise; the text appears if it takes long.
  async during(name, text, promise, patience = LONG_WAIT) {
    const timer = setTimeout(() => this.set(name, text), patience);
    try {
      return await promise;
    } finally {
      clearTimeout(timer);
      this.set(name, "");
    }
  }
}
