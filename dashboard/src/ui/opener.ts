/** What a person opened something with: it gets the focus back when that is closed. */

import { useRef } from "preact/hooks";

export interface Opener {
  /** Whether a person opened what is shown; else it takes nobody's focus. */
  readonly known: () => boolean;
  /** Note what has the focus now. */
  readonly note: () => void;
  readonly forget: () => void;
  readonly giveFocusBack: () => void;
}

export function useOpener(): Opener {
  const element = useRef<Element | null>(null);
  return useRef<Opener>({
    known: () => element.current !== null,
    note: () => {
      element.current = document.activeElement;
    },
    forget: () => {
      element.current = null;
    },
    giveFocusBack: () => {
      if (element.current instanceof HTMLElement) element.current.focus();
    },
  }).current;
}
