"""Contact sheets of modelled furniture, from a small library that the test writes."""

import numpy as np
import pytest
from furniture_library import write_library

from benchmarks.teachers import sheets
from chebsplat.synthetic import CLASS_NAMES
from chebsplat.synthetic.furnished import PIECES, Catalogue


@pytest.fixture(scope="module")
def catalogue(tmp_path_factory):
    return Catalogue(write_library(tmp_path_factory.mktemp("furniture")))


def test_a_piece_shows_its_front_in_its_colours_on_a_grey_floor(catalogue):
    picture = sheets.portrait(catalogue.groups["wardrobe"][0]).astype(int)
    red = (picture[..., 0] > 2 * picture[..., 1]) & (picture[..., 0] > 60)  # its front and back
    rows, columns = np.nonzero(red)
    assert 0.05 < red.mean() < 0.5 and np.ptp(rows) > np.ptp(columns)
    assert np.ptp(picture[-1].reshape(-1, 3), axis=1).max() < 12 and picture[-1].min() > 60


def test_pieces_are_drawn_in_a_row_for_each_group(catalogue):
    sheet = np.asarray(sheets.sheet_of_pieces(catalogue, columns=2))
    height = sheets.SIDE + sheets.CAPTION
    assert sheet.shape == (len(PIECES) * height, 2 * sheets.SIDE, 3)
    for row, pieces in enumerate(catalogue.groups.values()):
        top = row * height
        caption = sheet[top : top + sheets.CAPTION]
        assert caption.min() < 100 < caption.mean()
        cells = sheet[top + sheets.CAPTION : top + height].reshape(sheets.SIDE, 2, -1)
        drawn = [bool((cells[:, k] < 255).any()) for k in range(2)]
        assert drawn == [True, len(pieces) > 1]


def test_rooms_stand_above_their_labels_in_the_colours_of_the_legend(catalogue):
    sheet = np.asarray(sheets.sheet_of_rooms(catalogue, [22001]))
    width, height = sheets.ROOM
    assert sheet.shape == (2 * height + 2 * sheets.CAPTION, sheets.COLUMNS * width, 3)
    legend = {tuple(color) for color in sheet[2 * height :].reshape(-1, 3).tolist()}
    painted = sheet[height : 2 * height, :width].reshape(-1, 3)
    colors, counts = np.unique(painted, axis=0, return_counts=True)
    assert counts[[tuple(color) in legend for color in colors.tolist()]].sum() > 0.8 * len(painted)
    assert len(colors) > 2 and len(legend) > len(CLASS_NAMES) // 2
    assert (sheet[: 2 * height, width:] == 255).all()  # one room, the rest stays empty
