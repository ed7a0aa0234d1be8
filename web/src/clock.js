// Playback time of all flights.
export const RATES = [0.1, 0.25, 0.5, 1, 2, 4];

export class Clock {
  constructor(end) {
    this.end = end;
    this.time = 0;
    this.rate = 1;
    this.playing = false;
    this.onChange = () => {};
  }

  seek(time) {
    this.time = Math.min(Math.max(time, 0), this.end);
    this.onChange();
  }

  step(seconds) {
    this.playing = false;
    this.seek(this.time + seconds);
  }

  play(playing = true) {
    if (playing && this.time >= this.end) this.time = 0;
    this.playing = playing;
    this.onChange();
  }

  setRate(rate) {
    this.rate = rate;
    this.onChange();
  }

  faster(by) {
    const index = RATES.indexOf(this.rate) + by;
    this.setRate(RATES[Math.min(Math.max(index, 0), RATES.length - 1)]);
  }

  advance(seconds) {
    if (!this.playing) return false;
    this.time += this.rate * seconds;
    if (this.time >= this.end) {
      this.time = this.end;
      this.playing = false;
    }
    this.onChange();
    return true;
  }
}
