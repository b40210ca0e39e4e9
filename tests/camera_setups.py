"""Simulated set-ups of cameras and boards on robots, which tests calibrate without a first guess."""

from dataclasses import dataclass, replace

import numpy as np
from robots import paper

from dhcal_pin import Chain, calibrate, read_robot, select_parameters
from dhcal_pin.calibration.reweighting import Fit
from dhcal_pin.cameras import LENSES, Board, Camera, Rig
from dhcal_pin.estimation.error_model import ErrorModel
from dhcal_pin.estimation.initialization import make_problem
from dhcal_pin.estimation.solver import minimize
from dhcal_pin.measurements import KINDS, CameraCorners, Measurement, Noise, Pose
from dhcal_pin.measurements.mounting import MountedRig, mount_rig
from dhcal_pin.robot.inverse_kinematics import pose_task, solve_ik
from dhcal_pin.se3 import exp3, exp6, inverse, transform

ARMS = {
    "ur10": lambda: read_robot("example:ur10", tip="tool0"),
    "panda": lambda: read_robot("example:panda", tip="panda_link8"),
    "xarm7": lambda: read_robot("example:xarm7", tip="link_eef"),
    "paper": lambda: Chain.from_dh(paper("sim_6dof")),
}
WIDTH, HEIGHT = 1280, 960
# Smallest number of corners of a board in an image that a detector would report.
MIN_CORNERS = 8
# Limits of the depth of corners [m], and of the angle of the view to the normal of the board [rad].
DEPTHS, MAX_ANGLE = (0.15, 1.5), np.deg2rad(65)


@dataclass(frozen=True, eq=False)
class Setup:
    """Simulated images with the truth."""

    nominal: Chain  # Nominal robot
    truth: Chain  # Robot that the images are of
    images: CameraCorners  # Image coordinates with the rig as a user would write it
    exact: CameraCorners  # The same images without noise, with the true rig
    sigma: float  # Standard deviation of the noise [px]


def true_lens(rng: np.random.Generator, model: str, aspect: float) -> np.ndarray:
    """Return the values of a lens with distortion."""
    focal = rng.uniform(800, 1300)
    head = [
        focal,
        aspect * focal * rng.uniform(0.995, 1.005),
        639.5 + rng.normal(0, 10),
        479.5 + rng.normal(0, 10),
    ]
    if model == "fisheye":
        return np.array([*head, *rng.normal(0, [0.03, 0.01, 0.005, 0.002])])
    return np.array([*head, rng.uniform(-0.25, 0.15), rng.normal(0, 0.05), *rng.normal(0, 1e-3, 2), 0.0])


def make_board(rng: np.random.Generator, name: str, link: str) -> Board:
    """Return a board of any type, 15 to 30 cm wide."""
    kind = rng.choice(["checkerboard", "charuco", "aprilgrid", "points"])
    if kind == "points":
        points = rng.uniform(-0.12, 0.12, (20, 3)) * [1, 1, 0.4]
        return Board(name, link, "points", listed_points=points)
    columns, rows, square = int(rng.integers(6, 10)), int(rng.integers(5, 8)), rng.uniform(0.025, 0.03)
    if kind == "aprilgrid":
        return Board(name, link, "aprilgrid", columns=columns // 2, rows=rows // 2, square=1.6 * square,
                     spacing=0.4 * square)  # fmt: skip
    return Board(name, link, str(kind), columns=columns, rows=rows, square=square, marker=0.7 * square)


def home_configuration(chain: Chain, rng: np.random.Generator) -> np.ndarray:
    """Return joint values in the middle of their ranges, away from stretched arms."""
    lower, upper = chain.lower, chain.upper
    lower, upper = np.maximum(lower, -2.0), np.minimum(upper, 2.0)
    return lower + (upper - lower) * rng.uniform(0.3, 0.7, chain.n_joints)


def look_at(position: np.ndarray, target: np.ndarray, roll: float) -> np.ndarray:
    """Return the pose of a camera at a position that looks at a target."""
    z = (target - position) / np.linalg.norm(target - position)
    x = np.cross(z, [0.3, 0.2, 1.0] if abs(z[2]) < 0.9 else [1.0, 0.1, 0])
    x /= np.linalg.norm(x)
    return transform(np.column_stack([x, np.cross(z, x), z]) @ exp3(np.array([0, 0, roll])), position)


def simulate(
    chain: Chain,
    truth: Chain,
    rng: np.random.Generator,
    *,
    is_on_wrist: bool,
    n_images: int,
    sigma: float,
    spread: float = 0.5,
    model: str = "pinhole",
    n_cameras: int = 1,
    n_boards: int = 1,
    intrinsics_error: float = 0.05,
    aspect: float = 1.0,
    home: np.ndarray | None = None,
) -> Setup:
    """Simulate images of boards by cameras that stand still or are on the wrist.

    Configurations are drawn around a home configuration with a standard deviation of `spread` [rad]; those
    where no board is in view are dropped. `sigma` is the noise [px], `intrinsics_error` the relative error of
    focal lengths and image centre in the rig file, `aspect` the ratio of the focal lengths.
    """
    ends = ("tip", "world") if is_on_wrist else ("world", "tip")
    home = home_configuration(chain, rng) if home is None else home
    tool = truth.poses(home[None])[0]
    cameras, boards = {}, {}
    board_poses = []
    for i in range(n_boards):
        board = make_board(rng, f"board{i}", ends[1])
        # The tool, and in front of it or around it the middle of the boards, at the home configuration.
        offset = rng.uniform(-0.08, 0.08, 3)
        offset[2] += 0.45 if is_on_wrist else 0.06
        middle = transform(exp3(rng.normal(0, 0.2, 3)), offset + 0.2 * i * np.array([1, 0, 0]))
        centre = board.points.mean(0)
        turn = transform(exp3(np.array([np.pi, 0, 0]) if is_on_wrist else np.zeros(3)), np.zeros(3))
        board_poses.append(tool @ middle @ turn @ transform(np.eye(3), -centre))
        boards[board.name] = board
    seen = np.mean([pose[:3, :3] @ board.points.mean(0) + pose[:3, 3]
                    for pose, board in zip(board_poses, boards.values(), strict=True)], 0)  # fmt: skip
    camera_poses, lenses = [], []
    for i in range(n_cameras):
        side = rng.uniform(-0.05, 0.05, 3)
        side[0] += 0.12 * i
        side = tool[:3, :3] @ side
        position = tool[:3, 3] + side if is_on_wrist else seen + 0.7 * tool[:3, 2] + 3 * side
        camera_poses.append(look_at(position, seen, rng.uniform(-3, 3)))
        lenses.append(true_lens(rng, model, aspect))
        wrong = lenses[-1].copy()
        wrong[:2] *= 1 + intrinsics_error * rng.choice([-1, 1])
        wrong[2:4] += intrinsics_error * rng.uniform(-1, 1, 2) * [639.5, 479.5]
        wrong[4:] = 0.0
        cameras[f"camera{i}"] = Camera(f"camera{i}", ends[0], WIDTH, HEIGHT, wrong, LENSES[model])
    moves = (camera_poses, board_poses)[0 if is_on_wrist else 1]
    for i, pose in enumerate(moves):
        moves[i] = inverse(tool) @ pose
    true_rig = mount_rig(
        Rig(
            {
                c.name: located(c, p, v)
                for c, p, v in zip(cameras.values(), camera_poses, lenses, strict=True)
            },
            {b.name: located(b, p) for b, p in zip(boards.values(), board_poses, strict=True)},
        ),
        chain,
    )
    rig = mount_rig(Rig(cameras, boards), chain)
    lower, upper = chain.lower, chain.upper
    rows = []
    for _ in range(400):
        q = np.clip(home + rng.normal(0, spread, (20, chain.n_joints)), lower, upper)
        rows += visible_corners(truth, true_rig, q)
        if len(rows) >= n_images:
            break
    rows = rows[:n_images]
    if len(rows) < n_images:
        return simulate(chain, truth, rng, is_on_wrist=is_on_wrist, n_images=n_images, sigma=sigma,
                        spread=spread, model=model, n_cameras=n_cameras, n_boards=n_boards,
                        intrinsics_error=intrinsics_error, aspect=aspect, home=home)  # fmt: skip
    q, camera, board, corner, pixels = (np.concatenate(each) for each in zip(*rows, strict=True))
    names = [f"camera{i}" for i in camera], [f"board{i}" for i in board]
    noisy = pixels + sigma * rng.standard_normal(pixels.shape)
    images = CameraCorners(q, noisy, corner, rig, *names)
    return Setup(chain, truth, images, CameraCorners(q, pixels, corner, true_rig, *names), sigma)


def placement_fit(arm_error: float, n_images: int, seed: int, *, size: float = 1.0) -> Fit:
    """Fit the geometry of a UR10 and the poses of camera and board to images with a known lens.

    The links have errors of `arm_error` [m]; `size` is the stated size of the board over the true one.
    """
    rng, chain = np.random.default_rng(seed), ARMS["ur10"]()
    truth = wrong_arm(chain, arm_error, rng)
    setup = simulate(chain, truth, rng, is_on_wrist=True, n_images=n_images, sigma=0.2, intrinsics_error=0.0)
    rig = setup.exact.rig
    board = replace(rig.boards[0], type="points", listed_points=size * rig.boards[0].points)
    rig = replace(rig, boards=(board,))
    images = CameraCorners(setup.images.q, setup.images.values, setup.images.corner, rig).initialized(chain)
    lens = {p.name: p.nominal for p in images.instrument_parameters if images.set_of(p.name) == "intrinsics"}
    errors = select_parameters(chain, "placement")
    problem = make_problem(errors, (images,), 1 / errors.priors, lens)
    return Fit((images,), problem, minimize(problem, "lm", None, 40), (np.ones(len(images.rows)),))


def polyhedron_setup(seed: int, *, point_error: float, n_images: int = 40, sigma: float = 0.5) -> Setup:
    """Simulate two cameras that stand 2 m away from markers on the faces of an icosahedron on the tool.

    About four markers face a camera. `point_error` is that of the markers in the rig [m], `sigma` the noise
    [px].
    """
    rng, chain = np.random.default_rng(seed), ARMS["ur10"]()
    golden = (1 + np.sqrt(5)) / 2
    corners = np.array([[a, b, c] for a in (1, -1) for b in (1, -1) for c in (1, -1)], float)
    ring = np.array([[0, a / golden, b * golden] for a in (1, -1) for b in (1, -1)])
    normals = np.concatenate([corners, *(np.roll(ring, i, 1) for i in range(3))]) / np.sqrt(3)
    stated = 0.07 * normals
    true = stated + point_error * rng.standard_normal(stated.shape)
    board_pose = transform(exp3(rng.normal(0, 0.5, 3)), rng.uniform(-0.05, 0.05, 3))
    q = home_configuration(chain, rng) + rng.normal(0, 0.5, (n_images, chain.n_joints))
    tools = chain.poses(q)
    middle, width, height = tools[:, :3, 3].mean(0), 6000, 4000
    size = np.array([width, height])
    cameras, exact, rows = {}, {}, []
    for i, direction in enumerate(([1, 0.3, 0.4], [0.3, 1, 0.5])):
        position = middle + 2 * np.array(direction) / np.linalg.norm(direction)
        pose, lens = look_at(position, middle, rng.normal(0, 0.1)), LENSES["pinhole"]
        values = np.array([7000, 7010, *(size / 2 + rng.normal(0, 30, 2)), -0.05, 0.02, 1e-4, -1e-4, 0])
        wrong = np.array([7140, 7150, *(size / 2), 0, 0, 0, 0, 0])
        cameras[f"camera{i}"] = Camera(f"camera{i}", "world", width, height, wrong, lens)
        exact[f"camera{i}"] = replace(cameras[f"camera{i}"], values=values, pose=pose)
        for number, tool in enumerate(tools):
            local = inverse(pose) @ tool @ board_pose
            points = true @ local[:3, :3].T + local[:3, 3]
            sights = -points / np.linalg.norm(points, axis=1)[:, None]
            pixels = lens.project(points.T, values)[0].T
            is_seen = np.sum(normals @ local[:3, :3].T * sights, 1) > 0.5
            is_seen &= np.all((pixels > 0) & (pixels < size - 1), 1)
            rows += [(number, i, corner, *pixels[corner]) for corner in np.flatnonzero(is_seen)]
    table = np.array(rows)
    number, camera, corner = table[:, :3].astype(int).T
    names = [f"camera{i}" for i in camera]
    board = Board("body", "tip", "points", listed_points=stated)
    true_board = replace(board, listed_points=true, pose=board_pose)
    rig, true_rig = (
        mount_rig(Rig(each, {"body": one}), chain) for each, one in ((cameras, board), (exact, true_board))
    )
    noisy = table[:, 3:] + sigma * rng.standard_normal((len(table), 2))
    images = CameraCorners(q[number], noisy, corner, rig, names)
    return Setup(chain, chain, images, CameraCorners(q[number], table[:, 3:], corner, true_rig, names), sigma)


def located(entry, pose, values=None):
    """Return a camera or a board at a pose."""
    return replace(entry, pose=pose) if values is None else replace(entry, pose=pose, values=values)


def visible_corners(truth: Chain, rig: MountedRig, q: np.ndarray) -> list[tuple[np.ndarray, ...]]:
    """Return joint values, camera, board, corner and pixels of the corners in view, per configuration."""
    out = []
    for configuration, tool in zip(q, truth.poses(q), strict=True):
        found = []
        for c, camera in enumerate(rig.cameras):
            for b, board in enumerate(rig.boards):
                assert camera.pose is not None
                assert board.pose is not None
                camera_pose = tool @ camera.pose if rig.camera_mounts[c].moves else camera.pose
                board_pose = tool @ board.pose if rig.board_mounts[b].moves else board.pose
                local = inverse(camera_pose) @ board_pose
                points = board.points @ local[:3, :3].T + local[:3, 3]
                pixels = camera.lens.project(points.T, camera.values)[0].T
                is_seen = (points[:, 2] > DEPTHS[0]) & (points[:, 2] < DEPTHS[1])
                is_seen &= np.all((pixels > 5) & (pixels < [WIDTH - 6, HEIGHT - 6]), 1)
                # Far outside the image a distorted point can fold back into it.
                is_seen &= np.linalg.norm(points[:, :2], axis=1) < 0.9 * points[:, 2]
                is_seen &= abs(local[2, 2]) > np.cos(MAX_ANGLE)
                if is_seen.sum() >= MIN_CORNERS:
                    corner = np.flatnonzero(is_seen)
                    count = np.ones(len(corner), int)
                    found.append(
                        (np.outer(count, configuration), c * count, b * count, corner, pixels[is_seen])
                    )
        if found:
            out.append(tuple(np.concatenate(each) for each in zip(*found, strict=True)))
    return out


def tool_error(chain: Chain, truth: Chain, q: np.ndarray) -> float:
    """Return the RMS error of the tool at configurations with the best base and tool [m]."""
    measured = Pose(q, truth.poses(q))
    fit = calibrate(chain, measured, "base,tool", extend="none", session="off", loss="linear")
    return float(np.sqrt(np.mean(np.sum((fit.chain.poses(q) - truth.poses(q))[:, :3, 3] ** 2, 1))))


def wrong_arm(chain: Chain, size: float, rng: np.random.Generator) -> Chain:
    """Return an arm with errors of every link of a size [m], and of three times as many radians per metre."""
    errors: ErrorModel = select_parameters(chain, "placement")
    std = np.array([size if p.unit == "m" else 3 * size for p in errors.parameters])
    return errors.at(std * rng.standard_normal(len(std)))


def uneven_arm(chain: Chain, size: float, rng: np.random.Generator) -> Chain:
    """Return an arm with errors of links as in `wrong_arm`, with eccentric joints that yield to gravity."""
    errors: ErrorModel = select_parameters(chain, "placement,harmonics,compliance")
    sizes = {"m": size, "rad": 3 * size, "rad/Nm": 3e-6}
    orders = {"1": 1e-4, "2": 3e-5}
    std = np.array([orders[p.name[-1]] if p.name[-1] in orders else sizes[p.unit] for p in errors.parameters])
    return errors.at(std * rng.standard_normal(len(std)))


def random_setup(seed: int) -> Setup:
    """Return one of the set-ups: any arm, camera on the wrist or fixed, 15 to 60 images."""
    rng = np.random.default_rng(seed)
    chain = list(ARMS.values())[seed % len(ARMS)]()
    truth = wrong_arm(chain, (0.0, 3e-4, 3e-3)[seed // 8 % 3], rng)
    return simulate(
        chain,
        truth,
        rng,
        is_on_wrist=seed // 4 % 2 == 0,
        n_images=int(rng.integers(15, 61)),
        sigma=rng.uniform(0.1, 0.3),
        model="fisheye" if seed % 5 == 4 else "pinhole",
    )


def turned_configurations(
    chain: Chain, home: np.ndarray, rng: np.random.Generator, turns: np.ndarray, count: int = 300
) -> np.ndarray:
    """Return configurations within 0.2 m of home, with the tool turned by up to ± these vectors (t, 3)."""
    targets = np.repeat(chain.poses(home[None]), count, 0)
    targets[:, :3, 3] += rng.uniform(-0.2, 0.2, (count, 3))
    angles = rng.uniform(-1, 1, (count, len(turns))) @ turns
    targets[:, :3, :3] = targets[:, :3, :3] @ np.array([exp3(angle) for angle in angles])
    start = np.clip(home + rng.normal(0, 0.3, (count, chain.n_joints)), chain.lower, chain.upper)
    q, errors = solve_ik(chain, pose_task(targets, 0.3), start)
    return q[errors < 1e-6]


@dataclass(frozen=True, eq=False)
class TrackedSetup:
    """Positions by a tracker, and images by two fixed cameras; the arm keeps the orientation of its tool."""

    nominal: Chain  # Nominal robot
    truth: Chain  # Robot that was measured, with base and tool
    data: tuple[Measurement, ...]  # Positions and images, with the true poses of the cameras in the rig


def tracked_setup(name: str, size: float, seed: int, sigma: float = 0.2) -> TrackedSetup:
    """Simulate an arm with errors of a size [m], and images with noise of sigma [px]."""
    rng, chain = np.random.default_rng(seed), ARMS[name]()
    truth = wrong_arm(chain, size, rng)
    setup = simulate(chain, truth, rng, is_on_wrist=False, n_images=10, sigma=sigma, n_cameras=2)
    home = np.clip(setup.images.q.mean(0), chain.lower, chain.upper)
    q = turned_configurations(truth, home, rng, np.zeros((1, 3)))
    rows = visible_corners(truth, setup.exact.rig, q)[: rng.integers(20, 41)]
    base, tool = (exp6(np.r_[rng.uniform(-v, v, 3), rng.uniform(-1, 1, 3)]) for v in (2, 0.15))
    true_poses = [base @ camera.pose for camera in setup.exact.rig.cameras]
    rig = replace(setup.images.rig, cameras=tuple(map(located, setup.images.rig.cameras, true_poses)))
    q, camera, board, corner, pixels = (np.concatenate(each) for each in zip(*rows, strict=True))
    names = [f"camera{i}" for i in camera], [f"board{i}" for i in board]
    images = CameraCorners(q, pixels + sigma * rng.standard_normal(pixels.shape), corner, rig, *names)
    placed = truth.with_base_and_tool(base, tool)
    q = rng.uniform(np.maximum(chain.lower, -2.2), np.minimum(chain.upper, 2.2), (40, chain.n_joints))
    return TrackedSetup(chain, placed, (KINDS["position"].simulate(placed, q, Noise(5e-5), rng), images))


def photograph(setup: Setup, q: np.ndarray, rng: np.random.Generator, n_images: int) -> CameraCorners:
    """Take the first images at other configurations that show a board of a set-up of one camera and board."""
    rows = visible_corners(setup.truth, setup.exact.rig, q)[:n_images]
    assert len(rows) == n_images
    q, _, _, corner, pixels = (np.concatenate(each) for each in zip(*rows, strict=True))
    noisy = pixels + setup.sigma * rng.standard_normal(pixels.shape)
    return CameraCorners(q, noisy, corner, setup.images.rig)
