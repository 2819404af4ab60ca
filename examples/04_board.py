"""A camera beside the robot, by a printed board in the gripper.

`evercal detect --make-board board.pdf` prints one. The commands below are what you type; the images
are drawn, unless the folder `board` has yours.
"""

from pathlib import Path

from stand_ins import board_images

from evercal.cli import main

if not Path("board").exists():
    board_images(Path("board"))

detect = [
    *("detect", "board", "--camera", "board/camera.txt", "--out", "board/board.json"),
    *("--board", "charuco", "--size", "9x6", "--square-mm", "30", "--marker-mm", "22"),
    *("--dictionary", "5X5_100"),
]
solve = [
    *("solve", "--mount", "eye_to_hand", "--out", "tripod.json"),
    *("--robot-poses", "board/poses.csv", "--camera-poses", "board/board.json"),
]
main(detect)
main(solve)
main(["report", "tripod.json", "--out", "tripod.html"])
