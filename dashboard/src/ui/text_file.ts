/** Text files that a reader hands to the page. */

/** Return the text of the file that was chosen; null: none was. */
export async function takeText(input: HTMLInputElement): Promise<string | null> {
  const file = input.files?.[0];
  // Browsers do not report that a file is chosen which the input has already: it could not be read again once it was edited.
  input.value = "";
  return file ? readText(file) : null;
}

/** Return the text of a file. */
async function readText(file: File): Promise<string> {
  const content = new Uint8Array(await file.arrayBuffer());
  // What spreadsheet programs call Unicode is UTF-16 with a byte order mark.
  const encoding = content[0] === 0xff && content[1] === 0xfe ? "utf-16le" : content[0] === 0xfe && content[1] === 0xff ? "utf-16be" : "utf-8";
  return new TextDecoder(encoding).decode(content);
}
