"""Case map-holes: tables over volumes with holes, judged where they are valid."""
