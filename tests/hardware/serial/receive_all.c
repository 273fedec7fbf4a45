/* Gives all bytes of the standard input to a receiver; sanitizers watch. */
#include <stdio.h>

#include "lumiline_serial.h"

int main(void) {
    lumiline_receiver receiver = {0};
    lumiline_command command;
    unsigned commands = 0;
    int byte;
    while ((byte = getchar()) != EOF)
        commands += lumiline_receive(&receiver, (uint8_t)byte, &command);
    printf("%u %u\n", commands, (unsigned)receiver.discarded);
    return 0;
}
