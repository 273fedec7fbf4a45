"""The open TCD1304 board (STM32): a linear CCD read over a serial port."""
