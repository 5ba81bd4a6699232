"""The map of deposited roads: cooling law against finite differences and a published measurement; bounded memory."""

import math

import numpy as np
import pytest
from scipy import sparse
from scipy.linalg import solve_banded
from scipy.sparse.linalg import splu

import deposit_reference
from thermal.plan import deposit
from thermal.plan.materials import MATERIALS, SOURCES

ABS = MATERIALS["ABS"]


class Wall:
    """A single wall's cross section while its newest road cools: implicit finite differences over half its width and
    eight layers, written without the map's code. The air takes heat at the top and at the flank.
    """

    LAYERS = 8

    def __init__(
        self,
        material,
        deposited_c,
        base_c,
        air_c,
        h_w_m2k,
        thick_mm,
        width_mm,
        cells=10,
        across=8,
        step_s=4e-3,
    ):
        self.cells, self.step_s = cells, step_s
        alpha = 1e6 * material.diffusivity_m2_s
        loss = 1e3 * h_w_m2k / (material.density_kg_m3 * material.heat_j_kgk)  # mm/s
        rows, dz, dx = cells * self.LAYERS, thick_mm / cells, 0.5 * width_mm / across
        down, aside = self._chain(rows, alpha / dz**2), self._chain(across, alpha / dx**2)
        down[0, 0] -= loss / dz
        aside[-1, -1] -= loss / dx
        self.source = np.zeros((rows, across))
        self.source[0] += loss / dz * air_c
        self.source[:, -1] += loss / dx * air_c
        field = sparse.kron(down, sparse.eye(across)) + sparse.kron(sparse.eye(rows), aside)
        self.solve = splu(sparse.csc_matrix(sparse.eye(rows * across) - step_s * field)).solve
        self.field_c = np.full((rows, across), float(base_c))
        self.field_c[:cells] = deposited_c

    @staticmethod
    def _chain(count, exchange):
        ones = np.ones(count - 1)
        chain = exchange * (np.diag(ones, 1) + np.diag(ones, -1))
        return chain - np.diag(chain.sum(axis=1))

    def run(self, until_s):
        """Rows of (time, road's mean, weld's mean, middle of the road's upper face)."""
        rows = []
        for n in range(1, round(until_s / self.step_s) + 1):
            right = (self.field_c + self.step_s * self.source).ravel()
            self.field_c = self.solve(right).reshape(self.source.shape)
            weld_c = self.field_c[self.cells - 1 : self.cells + 1].mean()
            rows.append((n * self.step_s, self.field_c[: self.cells].mean(), weld_c, self.field_c[0, 0]))
        return np.array(rows)


def cooling_stack(material, deposited_c, base_c, air_c, h_w_m2k, thick_mm, ages_s, side_per_mm):
    """The same with the map a print uses: the two newest layers' temperatures at each age."""
    around = deposit.Surroundings(bed_c=air_c, chamber_c=air_c, still_w_m2k=h_w_m2k)
    deposited, rows = deposit_reference.DepositMap(material, around), []
    for age_s in ages_s:
        thick = [thick_mm] * (deposit_reference.NODES - 1) + [deposit_reference.FAR_MM]
        temps = [deposited_c] + [base_c] * (deposit_reference.NODES - 1)
        column = deposit_reference.Column(0.0, 50.0, 0.0, base_c, 1.0, 1.0, side_per_mm, thick, temps)
        deposited.cool(column, age_s)
        rows.append(column.temp_c[:2])
    return np.array(rows)


def layer_on_half_space(fourier, deposited_c, base_c):
    """Upper face and weld of a layer after fourier = alpha t/d2, no loss to the air, layer and base of one medium:
    Carslaw & Jaeger, by images."""
    reach = 2.0 * math.sqrt(fourier)
    face_c = base_c + (deposited_c - base_c) * math.erf(1.0 / reach)
    return face_c, base_c + 0.5 * (deposited_c - base_c) * math.erf(2.0 / reach)


@pytest.mark.parametrize(("fourier", "within_c"), [(0.25, 7.0), (0.5, 3.0), (1.0, 1.0), (4.0, 1.5)])
def test_the_stack_agrees_with_the_exact_solution_of_a_layer_on_a_half_space(fourier, within_c):
    """The newest node stands for the road's upper face, which the next layer meets, the mean of the two newest for the
    weld between them. One node a layer lags at first; 0.25 d2/alpha are 0.26 s at 0.3 mm, and no layer comes that soon.
    """
    age_s = fourier * 0.3**2 / (1e6 * ABS.diffusivity_m2_s)
    face_c, weld_c = layer_on_half_space(fourier, 230.0, 80.0)
    stack = cooling_stack(ABS, 230.0, 80.0, 25.0, 0.0, 0.3, [age_s], 0.0)[0]
    assert stack[0] == pytest.approx(face_c, abs=within_c)
    assert stack.mean() == pytest.approx(weld_c, abs=1.5)


def test_finite_differences_agree_with_the_exact_solution():
    """The reference of the tests below; 0.1 degC."""
    fourier, steps = 1.0, 2000
    step_s = fourier * 0.3**2 / (1e6 * ABS.diffusivity_m2_s) / steps
    wall = Wall(ABS, 230.0, 80.0, 25.0, 0.0, 0.3, 0.45, cells=60, across=1, step_s=step_s)
    face_c, weld_c = layer_on_half_space(fourier, 230.0, 80.0)
    assert wall.run(steps * step_s)[-1, 2:] == pytest.approx([weld_c, face_c], abs=0.1)


@pytest.mark.parametrize(("thick_mm", "h_w_m2k"), [(0.3, 60.0), (0.2, 30.0), (0.2, 90.0)])
def test_a_single_wall_cools_as_in_two_dimensions(thick_mm, h_w_m2k):
    """The stack knows flanks as a loss per volume only (Biot number h w/2k below 0.12)."""
    width_mm = 0.45
    fine = Wall(ABS, 230.0, 80.0, 40.0, h_w_m2k, thick_mm, width_mm).run(4.0)
    for age_s, within_c in ((0.5, 8.0), (1.0, 4.0), (2.0, 2.5), (4.0, 2.5)):
        _, road_c, weld_c, face_c = fine[round(age_s / 4e-3) - 1]
        stack = cooling_stack(ABS, 230.0, 80.0, 40.0, h_w_m2k, thick_mm, [age_s], 2.0 / width_mm)[0]
        assert stack[0] == pytest.approx(road_c, abs=within_c)
        assert stack[0] == pytest.approx(face_c, abs=4.0)  # what the next layer meets
        assert stack.mean() == pytest.approx(weld_c, abs=5.0)


MEASURED_K_S, MEASURED_S, EITHER_WAY = 100.0, 1.0, 1.5


@pytest.mark.parametrize("base_c", [60.0, 80.0])
def test_a_road_of_abs_cools_as_was_measured_by_infrared(base_c):
    """Seppala & Migler, Additive Manufacturing 12 (2016) 71-76, doi 10.1016/j.addma.2016.06.007, abstract: from the
    profiles of road and sublayers the weld of ABS falls at approximately 100 degC/s and stays above Tg for
    approximately 1 s. The group's next paper (Davis et al., ibid. 16 (2017), doi 10.1016/j.addma.2017.06.006) has a
    MakerBot 2X, a 0.4 mm nozzle, layers of 0.3 mm, 210 to 250 degC.

    Rate times time is a fall of 100 degC to Tg: that is the road's way (230 to 115), on average. The plane of the weld
    begins at the mean of road and sublayer and has 40 degC to fall, at 36 to 41 degC/s where it is steepest. A factor
    of 1.5: both figures are given to one digit, and what is not given moves them by as much: sublayer 60 to 80 degC by
    25 %, exchange 30 to 90 W/m2K by 30 %, ABS's diffusivity by 50 % (Horoshailo 2019's range).
    """
    thick_mm, width_mm, deposited_c, air_c, h_w_m2k = 0.3, 0.45, 230.0, 40.0, 60.0
    ages = np.linspace(0.02, 4.0, 200)
    stack = cooling_stack(ABS, deposited_c, base_c, air_c, h_w_m2k, thick_mm, ages, 2.0 / width_mm)
    fine = Wall(ABS, deposited_c, base_c, air_c, h_w_m2k, thick_mm, width_mm).run(4.0)
    for times, road_c, weld_c in (
        (ages, stack[:, 0], stack.mean(axis=1)),
        (fine[:, 0], fine[:, 1], fine[:, 2]),
    ):
        road_s, weld_s = times[np.argmax(road_c < ABS.bonding_c)], times[np.argmax(weld_c < ABS.bonding_c)]
        rate_k_s = (deposited_c - ABS.bonding_c) / road_s
        steepest_k_s = -np.gradient(weld_c, times).min()
        print(
            f"road {rate_k_s:.0f} K/s to Tg in {road_s:.2f} s; weld above it {weld_s:.2f} s, {steepest_k_s:.0f} K/s"
        )
        assert MEASURED_K_S / EITHER_WAY < rate_k_s < MEASURED_K_S * EITHER_WAY
        assert MEASURED_S / EITHER_WAY < weld_s < MEASURED_S * EITHER_WAY
        assert steepest_k_s < MEASURED_K_S / EITHER_WAY  # it is not the plane's slope that was given


def fine_stack(layers, thick_mm, layer_s, melt_c, around, side_per_mm, cells=20, steps=1000):
    """What each new layer meets: implicit finite differences, 20 cells a layer, written without the map's code."""
    loss = 1e3 * around.still_w_m2k / (ABS.density_kg_m3 * ABS.heat_j_kgk)
    dz, step_s = thick_mm / cells, layer_s / steps
    far = 1e6 * ABS.diffusivity_m2_s * step_s / dz**2
    field, met = np.zeros(0), []
    for n in range(layers):
        met.append(field[0] if len(field) else around.bed_c)
        field = np.concatenate([np.full(cells, melt_c), field])
        air_c = around.around_c(thick_mm * (n + 1))
        bands = np.zeros((3, len(field)))
        bands[0, 1:] = bands[2, :-1] = -far
        bands[1] = 1 + 2 * far + loss * side_per_mm * step_s
        bands[1, 0] += -far + loss * step_s / dz
        bands[1, -1] += far  # the bed's face is half a cell away
        for _ in range(steps):
            right = field + loss * side_per_mm * step_s * air_c
            right[0] += loss * step_s / dz * air_c
            right[-1] += 2 * far * around.bed_c
            field = solve_banded((1, 1), bands, right)
    return np.array(met)


def coarse_stack(layers, thick_mm, layer_s, melt_c, around, filled):
    deposited = deposit_reference.DepositMap(ABS, around)
    length_mm = filled * 4.0 / 0.45  # so much road in a column of 2 mm
    return np.array(
        [
            deposited.deposit(
                (1.0, 1.0, thick_mm * (n + 1)), layer_s * n, melt_c, thick_mm, 100.0 * n, 0.45, length_mm
            )
            for n in range(layers)
        ]
    )


@pytest.mark.parametrize(
    ("thick_mm", "layer_s", "still", "filled", "within_c"),
    [
        (0.2, 20.0, 30.0, 1.0, 1.5),
        (0.2, 3.0, 30.0, 1.0, 1.5),
        (0.2, 1.0, 60.0, 0.225, 3.5),
        (0.15, 5.0, 60.0, 0.225, 3.5),
    ],
)
def test_a_stack_of_layers_agrees_with_finite_differences(thick_mm, layer_s, still, filled, within_c):
    """One node a layer against twenty cells: what is met is the mean of a layer, not its upper face. 3.5 degC of
    substrate are 1.7 degC of weld, a tenth of what layers of unlike places differ by.
    """
    around = deposit.Surroundings(bed_c=90.0, chamber_c=40.0, still_w_m2k=still)
    side = 2.0 * (1.0 - filled) / 0.45
    fine = fine_stack(20, thick_mm, layer_s, 220.0, around, side)
    coarse = coarse_stack(20, thick_mm, layer_s, 220.0, around, filled)
    assert np.abs(fine - coarse).max() < within_c
    assert np.ptp(fine) > within_c  # there is something to agree about


def test_small_layers_stay_warmer_than_large_ones():
    around = deposit.Surroundings()
    quick, slow = (coarse_stack(40, 0.2, layer_s, 230.0, around, 1.0)[-1] for layer_s in (3.0, 60.0))
    assert quick > slow + 50.0  # a block of 3 s a layer is molten through
    assert slow > 24.0


def test_a_single_wall_cools_through_its_flanks():
    around = deposit.Surroundings()
    wall, block = (coarse_stack(40, 0.2, 5.0, 230.0, around, filled)[-1] for filled in (0.225, 1.0))
    assert wall < block - 20.0


def test_a_road_is_not_its_own_substrate():
    deposited = deposit_reference.DepositMap(ABS, deposit.Surroundings(bed_c=90.0))
    met = [
        deposited.deposit((0.1 * n, 0.0, 0.2), 0.002 * n, 230.0, 0.2, 0.1 * n, length_mm=0.1)
        for n in range(60)
    ]
    assert met == [90.0] * 60  # 6 mm in three columns, chords of 0.1 mm
    column = deposited._cells[0, 0]
    deposited.cool(column, 0.3)
    neighbour_c = column.temp_c[0]
    assert 100.0 < neighbour_c < 200.0
    back = deposited.deposit((0.5, 0.4, 0.2), 0.3, 230.0, 0.2, odometer_mm=50.0, width_mm=0.4)
    assert back == pytest.approx((0.4 * 90.0 + 0.2 * neighbour_c) / 0.6)


def test_a_leaning_wall_lies_on_the_wall_beside_it():
    """Its road leaves a column for the next one, where nothing lies: no bed is met 8 mm above it."""
    deposited = deposit_reference.DepositMap(ABS, deposit.Surroundings(bed_c=100.0))
    met = [
        deposited.deposit((0.05 * n, 1.0, 0.2 * (n + 1)), 4.0 * n, 230.0, 0.2, 100.0 * n, length_mm=2.0)
        for n in range(60)
    ]
    inside, entering = met[35:39], met[40]
    assert abs(entering - inside[-1]) < 2.0
    alone = deposited.deposit((31.0, 1.0, 12.0), 250.0, 230.0, 0.2, 7000.0)
    assert alone == pytest.approx(deposited.surroundings.around_c(12.0))  # in mid air


def test_where_a_part_stood_the_next_one_finds_the_bed():
    """Two prints without a sign between them: the first is 4 mm high and still warm."""
    deposited = deposit_reference.DepositMap(ABS, deposit.Surroundings(bed_c=60.0))
    for i in range(20):
        deposited.deposit((1.0, 1.0, 0.2 * (i + 1)), 5.0 * i, 240.0, 0.2, 100.0 * i)
    assert (
        deposited.deposit((1.0, 1.0, 2.4), 101.0, 240.0, 0.2, 2100.0) > 70.0
    )  # as low as that it may be a bent bed
    assert deposited.deposit((1.0, 1.0, 0.2), 110.0, 240.0, 0.2, 2200.0) == 60.0
    assert 60.0 < deposited.deposit((1.0, 1.0, 0.4), 115.0, 240.0, 0.2, 2300.0) < 240.0


def test_memory_goes_with_area_not_with_moves():
    deposited = deposit_reference.DepositMap(ABS, deposit.Surroundings())
    for n in range(20000):
        at = ((n * 7 % 200) / 10, (n * 13 % 200) / 10, 0.2 + n // 200 * 0.2)
        deposited.deposit(at, n * 0.05, 230.0, 0.2, odometer_mm=2.0 * n)
    assert len(deposited) <= 100  # 20 mm square in 2 mm cells


def test_empty_bed_is_the_first_substrate():
    deposited = deposit_reference.DepositMap(ABS, deposit.Surroundings(bed_c=100.0))
    assert deposited.deposit((0.0, 0.0, 0.2), 0.0, 230.0, 0.2, odometer_mm=0.0) == 100.0


def test_every_number_of_a_material_names_a_known_source():
    assert set(MATERIALS) == {"ABS", "PLA", "PETG", "PA", "PC", "PEI", "PEEK", "HDPE"}
    used = {key for material in MATERIALS.values() for key in material.origin}
    assert used == set(SOURCES)
    for material in MATERIALS.values():
        assert len(material.origin) == 7
        assert material.low_c < material.high_c
        assert material.bonding_c <= material.flow_c <= material.high_c
        assert 5e-8 < material.diffusivity_m2_s < 2e-7  # polymers; Horoshailo 2019 has 5.3e-8 to 1.5e-7


# As printed: W/mK, J/kgK, kg/m3, glass transition degC; None: not given there.
CRAWFORD = {
    "ABS": (0.25, 1300, 1040, 115),
    "PET": (0.20, 1000, 1360, 75),
    "PA": (0.24, 1700, 1140, 56),
    "PC": (0.20, 1200, 1150, 149),
    "PEI": (0.22, None, 1270, 200),
    "PEEK": (None, None, 1300, 143),
    "HDPE": (0.25, 2200, 950, -120),
}


def test_the_numbers_taken_from_crawford_are_those_of_his_table():
    checked = 0
    for material in MATERIALS.values():
        numbers = (
            material.conductivity_w_mk,
            material.heat_j_kgk,
            material.density_kg_m3,
            None,
            material.bonding_c,
        )
        for number, origin, column in zip(numbers, material.origin, (0, 1, 2, None, 3), strict=False):
            if origin in ("CR", "PET") and column is not None:
                row = CRAWFORD["PET" if origin == "PET" else material.name]
                assert number == row[column], f"{material.name}: {number}, printed {row[column]}"
                checked += 1
    assert checked >= 12


# From places these numbers were not taken from: nozzle temperature low and high, density (PC: 1300 there, 1190 at
# Ultimaker, 1150 here after Crawford: left out); glass transition or melting.
TIGERTAG = {  # github.com/TigerTag-Project/TigerTag-RFID-Guide, database/id_material.json
    "ABS": (240, 280, 1040),
    "PLA": (190, 240, 1240),
    "PETG": (220, 270, 1270),
    "PC": (260, 290, None),
    "PEI": (370, 420, 1270),
}
TRANSITION = {  # github.com/hyiger/filament-db, wiki, FDM Appendices, A.1; PC: Autodesk Inventor help
    "ABS": (105, 115),
    "PLA": (55, 65),
    "PETG": (75, 88),
    "PA": (255, 265),
    "PC": (147, 150),
    "HDPE": (130, 137),
}


def test_the_table_agrees_with_other_collections():
    """Windows overlap by half of the narrower, densities agree within 1 %, transitions lie inside the printed range."""
    for name, (low_c, high_c, density) in TIGERTAG.items():
        material = MATERIALS[name]
        overlap = min(material.high_c, high_c) - max(material.low_c, low_c)
        assert overlap >= 0.5 * min(material.high_c - material.low_c, high_c - low_c), name
        assert density is None or material.density_kg_m3 == pytest.approx(density, rel=0.01), name
    for name, (low_c, high_c) in TRANSITION.items():
        assert low_c <= MATERIALS[name].bonding_c <= high_c, name
