"""Printed and painted pictures: labels, book spines, paintings, a chessboard, a clock face."""

import cv2
import numpy as np
from numpy.random import Generator

from evercal.simulation.textures import dead_leaves
from rooms.materials import Colour, Material, clipped

_WORDS = (
    "ROBOT", "LIGHT", "RIVER", "NORTH", "ATLAS", "CAMERA", "METHODS", "KITCHEN", "ORANGE",
    "VISION", "GARDEN", "STEEL", "PHYSICS", "OCEAN", "SALT", "TEA", "FLOUR", "RICE", "COFFEE",
    "HONEY", "SUGAR", "PASTA", "OATS", "MAPS", "POEMS", "STARS", "WINTER", "TRAINS", "MOTION",
    "PAPER",
)  # fmt: skip
BOOKS = 16
"""Number of spines in one `spines` texture."""


def painting(name: str, rng: Generator) -> Material:
    """A painting."""
    picture = dead_leaves(256, 320, rng, int(rng.integers(25, 120))).astype(np.float32)
    if rng.random() < 0.5:  # a landscape behind: sky above, ground below
        above = np.linspace(0, 1, 256)[:, None, None] < rng.uniform(0.4, 0.7)
        sky = rng.uniform(120, 230, 3)
        ground = rng.uniform(30, 150, 3)
        picture = 0.45 * picture + 0.55 * np.where(above, sky, ground)
    return Material(name, clipped(picture), kind="coated", roughness=0.3)


def label(name: str, rgb: Colour, rng: Generator) -> Material:
    """Printed packaging: a word, small print, a bar code."""
    picture = np.full((256, 256, 3), np.array(rgb) * 255, np.uint8)
    dark = rng.integers(0, 90, 3).tolist()
    light = rng.integers(190, 256, 3).tolist()
    cv2.rectangle(picture, (12, 40), (244, 130), light, -1)
    word = rng.choice(_WORDS)
    font = cv2.FONT_HERSHEY_DUPLEX
    scale = 240 / max(cv2.getTextSize(word, font, 1.0, 2)[0][0], 120)
    cv2.putText(picture, word, (16, 105), font, scale * 0.9, dark, 2)
    for y in range(155, 219, 16):
        text = " ".join(rng.choice(_WORDS, 3)).lower()
        cv2.putText(picture, text, (16, y), cv2.FONT_HERSHEY_PLAIN, 0.9, light, 1)
    bars = np.repeat(rng.integers(0, 2, 32), 2) * 255
    picture[222:250, 170:234] = bars[:, None]
    return Material(name, picture, kind="coated", roughness=0.3)


def spines(name: str, rng: Generator) -> Material:
    """Sixteen book spines side by side, with titles that run upwards."""
    cells = []
    for _ in range(BOOKS):
        brightness = rng.uniform(0.08, 0.85)
        colour = np.clip(brightness + rng.uniform(-0.25, 0.25, 3), 0.03, 0.95) * 255
        lying = np.full((64, 512, 3), colour, np.uint8)
        ink = (25, 25, 30)
        if colour.mean() < 120:
            ink = (245, 235, 205)
        for x in rng.integers(10, 60, 2).tolist():
            cv2.line(lying, (x, 0), (x, 64), ink, int(rng.integers(1, 4)))
        title = " ".join(rng.choice(_WORDS, rng.integers(1, 3)))
        font = int(rng.integers(0, 5))
        cv2.putText(lying, title, (75, 42), font, 1.0, ink, 2, cv2.LINE_AA)
        author = rng.choice(_WORDS).lower()
        cv2.putText(lying, author, (400, 40), 0, 0.5, ink, 1, cv2.LINE_AA)
        cells.append(np.rot90(lying))
    picture = np.concatenate(cells, 1).astype(np.float32)
    picture *= (1 + 0.03 * rng.standard_normal(picture.shape[:2]))[..., None]
    return Material(name, clipped(picture), kind="coated", roughness=0.35)


def chessboard(name: str, columns: int, rows: int) -> Material:
    """A printed chessboard with a white margin of one square, black squares in its corners."""
    squares = np.indices((rows, columns)).sum(0) % 2 * 225.0 + 15
    picture = np.kron(np.pad(squares, 1, constant_values=240), np.ones((32, 32)))
    return Material(name, np.repeat(picture[..., None], 3, -1).astype(np.uint8))


def clock_face(name: str) -> Material:
    """Twelve strokes, numbers and two hands."""
    face = np.full((256, 256, 3), 238, np.uint8)
    black = (20, 20, 20)
    for hour in range(12):
        angle = 2 * np.pi * hour / 12
        direction = np.array([np.sin(angle), -np.cos(angle)])
        inner = (128 + 108 * direction).astype(int).tolist()
        outer = (128 + 120 * direction).astype(int).tolist()
        cv2.line(face, inner, outer, black, 5)
        corner = (128 + 88 * direction - (12, -8)).astype(int).tolist()
        cv2.putText(face, str(hour or 12), corner, 0, 0.7, black, 2)
    cv2.line(face, (128, 128), (176, 96), (15, 15, 15), 6)
    cv2.line(face, (128, 128), (104, 40), (15, 15, 15), 4)
    return Material(name, face, kind="coated", roughness=0.15)
