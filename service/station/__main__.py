"""``python -m service.station``: a station, started by its gateway."""

from service.station.process import main

main()
