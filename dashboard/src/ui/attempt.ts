/** What a function gives, or why it gives nothing. */

/** Return what a function gives, or the message of its error. */
export function attempt<T>(read: () => T): T | string {
  try {
    return read();
  } catch (error) {
    return (error as Error).message;
  }
}
