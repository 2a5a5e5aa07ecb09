"""Point clouds: ground filter, DSM, DTM and orthophoto."""
