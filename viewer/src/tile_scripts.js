// Loads tiles/NAME.js: browsers read no other files from file://. Each calls FLEXROAD.tile(id, data).

const AT_ONCE = 2;

export class TileScripts {
  constructor() {
    this.waiting = new Map();
    this.queue = [];
    this.running = 0;
  }

  /** Returns the data of a tile as a promise; it fails if its file is missing or damaged. */
  load(tile) {
    const known = this.waiting.get(tile.id);
    if (known) return known.promise;
    const job = { tile };
    job.promise = new Promise((resolve, reject) => Object.assign(job, { resolve, reject }));
    this.waiting.set(tile.id, job);
    this.queue.push(job);
    this.next();
    return job.promise;
  }

  /** Removes tiles from the queue that are no longer needed. */
  keepOnly(wanted) {
    for (const job of this.queue.filter(({ tile }) => !wanted.has(tile))) {
      this.waiting.delete(job.tile.id);
      job.reject(new Error("no longer wanted"));
    }
    this.queue = this.queue.filter(({ tile }) => wanted.has(tile));
  }

  /** Takes the data of a tile's script. */
  take(id, data) {
    const job = this.waiting.get(id);
    if (job) job.data = data;
  }

  next() {
    while (this.running < AT_ONCE && this.queue.length) this.start(this.queue.shift());
  }

  start(job) {
    this.running += 1;
    const script = document.createElement("script");
    const done = () => {
      script.remove();
      this.running -= 1;
      this.waiting.delete(job.tile.id);
      if (job.data) job.resolve(job.data);
      else job.reject(new Error(`tiles/${job.tile.file}.js is missing or damaged; write the folder again`));
      this.next();
    };
    script.onload = script.onerror = done;
    script.src = `tiles/${encodeURIComponent(job.tile.file)}.js`;
    document.head.append(script);
  }
}
