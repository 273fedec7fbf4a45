"""``python -m service.station``: the process that stations are forked from."""

from service.station.station_starter import main

main()
