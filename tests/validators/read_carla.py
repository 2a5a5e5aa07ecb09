"""Print places on the lanes of an OpenDRIVE file as CARLA reads them, as JSON: road, x, y and height (m).

Usage: read_carla.py FILE DISTANCE_M
"""

import json
import sys
from pathlib import Path

import carla

places = []
for waypoint in carla.Map("roads", Path(sys.argv[1]).read_text()).generate_waypoints(float(sys.argv[2])):
    place = waypoint.transform.location
    # CARLA's y points to the south.
    places.append([waypoint.road_id, place.x, -place.y, place.z])
json.dump(places, sys.stdout)
