"""The open TCD1304 board (STM32): a linear CCD at a serial port, read line by line."""
