/** Numbers requests, so that a late answer to an older one does not overwrite that to a newer one. */
export class RequestOrder {
  private begun = 0;
  private answered = 0;

  /** Return the number of a request that is sent now. */
  begin(): number {
    return ++this.begun;
  }

  /** Take the answer to a request: return whether no newer one was answered before. */
  isNewest(number: number): boolean {
    if (number < this.answered) return false;
    this.answered = number;
    return true;
  }
}
