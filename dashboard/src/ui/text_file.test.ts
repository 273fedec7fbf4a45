import { expect, test } from "vitest";
import { takeText } from "./text_file";

test("the chosen file is read, and the input emptied, so that the same file can be chosen again", async () => {
  const files = [new File(["X,Y,Z\n1,2,3\n"], "targets.csv")];
  // As a browser's: emptied, it has no files.
  const input = {
    value: "C:\\fakepath\\targets.csv",
    get files() {
      return this.value ? files : [];
    },
  };
  const taken = takeText(input as unknown as HTMLInputElement);
  expect(input.value).toBe("");
  expect(await taken).toBe("X,Y,Z\n1,2,3\n");
  expect(await takeText(input as unknown as HTMLInputElement)).toBeNull();
});

test("what spreadsheet programs call Unicode is read, too", async () => {
  const input = { value: "table.txt", files: [new File([new Uint8Array([0xff, 0xfe, 0x58, 0x00])], "table.txt")] };
  expect(await takeText(input as unknown as HTMLInputElement)).toBe("X");
});
