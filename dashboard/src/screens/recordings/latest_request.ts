/** Requests for the newest view alone, one at a time. */

interface Source<View> {
  /** The newest view; null: there is nothing to load. */
  view: () => View | null;
  /** Load a view and show it, unless the signal is aborted. */
  load: (view: View, signal: AbortSignal) => Promise<void>;
  /** Whether a newer view makes the answer to the one in flight useless. */
  outdates: (newer: View, loading: View) => boolean;
  /** Take the failure of the newest view. */
  failed: (failure: unknown) => void;
}

/** Loads the newest view; views that come and go while another one is loaded are left out. */
export class LatestRequest<View> {
  private flight: { view: View; controller: AbortController } | null = null;
  private closed = false;

  constructor(private readonly source: Source<View>) {}

  /** Whether a view is being loaded. */
  get busy(): boolean {
    return this.flight !== null;
  }

  /** Load the newest view, after the one that is being loaded. */
  async show(): Promise<void> {
    if (this.flight) {
      const newer = this.source.view();
      if (newer === null || this.source.outdates(newer, this.flight.view)) this.flight.controller.abort();
      return;
    }
    let loaded: View | null = null;
    for (let view = this.source.view(); !this.closed && view !== null && !same(view, loaded); view = this.source.view()) {
      loaded = view;
      const controller = new AbortController();
      this.flight = { view, controller };
      try {
        await this.source.load(view, controller.signal);
      } catch (failure) {
        if (!controller.signal.aborted && same(this.source.view(), view)) this.source.failed(failure);
      } finally {
        this.flight = null;
      }
      // One that was aborted and is wanted again is loaded again.
      if (controller.signal.aborted) loaded = null;
    }
  }

  /** Abort what is being loaded, and load nothing more. */
  close(): void {
    this.closed = true;
    this.flight?.controller.abort();
  }
}

function same(a: unknown, b: unknown): boolean {
  return JSON.stringify(a) === JSON.stringify(b);
}
