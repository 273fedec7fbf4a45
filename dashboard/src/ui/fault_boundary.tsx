/** Keeps a fault of one screen from the rest of the page: says it in place of the screen. */

import { Component, type ComponentChildren } from "preact";
import { text } from "../text";
import { Panel } from "./parts";

interface Props {
  /** Name of the screen. */
  screen: string;
  children: ComponentChildren;
}

export class FaultBoundary extends Component<Props, { fault: string | null }> {
  override state = { fault: null as string | null };

  override componentDidCatch(error: unknown): void {
    this.setState({ fault: error instanceof Error ? error.message : String(error) });
    // In the browser's console it stays an uncaught error, with its stack.
    reportError(error);
  }

  override render({ screen, children }: Props) {
    const { fault } = this.state;
    if (fault === null) return children;
    return (
      <Panel title={text.fault.title(screen)}>
        <p class="failure" role="alert">
          {fault}
        </p>
        <p>{text.fault.help}</p>
        <button type="button" onClick={() => this.setState({ fault: null })}>
          {text.fault.again}
        </button>
      </Panel>
    );
  }
}
