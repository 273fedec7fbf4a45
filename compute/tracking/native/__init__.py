"""Native source of the association of peaks with tracks, and of the filter's updates; CPU only."""
