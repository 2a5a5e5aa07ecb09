"""Oracle for `tasks.filter.ecsrc`: Algorithm 1 of the paper, line by line, with Python sets."""

import math


def grow(heights: dict, theta_z: float) -> dict:
    """Lines 3 to 14: grow one cluster from each point not yet visited."""
    neighbours = {
        (i, j): {
            (i + di, j + dj)
            for di in (-1, 0, 1)
            for dj in (-1, 0, 1)
            if (di, dj) != (0, 0)
            and (i + di, j + dj) in heights
            and abs(heights[i + di, j + dj] - heights[i, j]) <= theta_z
        }
        for i, j in heights
    }
    labels, label = dict.fromkeys(heights, 0), 1
    for start in heights:
        if labels[start] == 0:
            visited, queue = set(), {start}
            while queue:
                point = queue.pop()
                if point not in visited:
                    visited.add(point)
                    labels[point] = label
                    queue |= neighbours[point]
            label += 1
    return labels


def merge(heights: dict, labels: dict, theta_xy: float, theta_z: float, cell: float) -> dict:
    """Line 15: merge clusters while any two of their points are near in plan and in height."""
    n = int(theta_xy / cell + 1e-6)
    span = range(-n, n + 1)
    steps = [(di, dj) for di in span for dj in span if math.hypot(di, dj) * cell <= theta_xy + 1e-9]
    touching = {label: set() for label in set(labels.values())}
    for (i, j), z in heights.items():
        for di, dj in steps:
            neighbour = (i + di, j + dj)
            if neighbour in heights and abs(heights[neighbour] - z) <= theta_z:
                touching[labels[i, j]].add(labels[neighbour])
    merged = {}
    for label in sorted(touching):
        queue = {label} - merged.keys()
        while queue:
            member = queue.pop()
            merged[member] = label
            queue |= touching[member] - merged.keys()
    return {point: merged[label] for point, label in labels.items()}


def clean(labels: dict, cell: float, min_area: float, keep: int | None) -> dict:
    """Line 16: keep the k largest of the large clusters, numbered in the order of their first points."""
    clusters = {}
    for point in sorted(labels):
        clusters.setdefault(labels[point], []).append(point)
    large = [c for c in clusters.values() if round(len(c) * cell**2, 6) >= min_area]
    kept = sorted(large, key=lambda c: (-len(c), c[0]))[:keep]
    out = dict.fromkeys(labels, 0)
    for number, cluster in enumerate(sorted(kept, key=lambda c: c[0]), start=1):
        out |= dict.fromkeys(cluster, number)
    return out


def points(mask, dsm) -> dict:
    """The road points with a height: (row, col) -> m, in row-major order."""
    rows, cols = mask.shape
    return {
        (i, j): float(dsm[i, j])
        for i in range(rows)
        for j in range(cols)
        if mask[i, j] and not math.isnan(dsm[i, j])
    }


def labels(mask, dsm, cell: float, options) -> list[list[int]]:
    """Whole Algorithm 1; returns rows of labels."""
    heights = points(mask, dsm)
    result = grow(heights, options.theta_z_m)
    result = merge(heights, result, options.theta_xy_m, options.theta_z_m, cell)
    result = clean(result, cell, options.min_area_m2, options.keep_largest)
    return [[result.get((i, j), 0) for j in range(mask.shape[1])] for i in range(mask.shape[0])]
