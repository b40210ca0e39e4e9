"""Command check."""

import numpy as np
from command_line import parse_json
from robots import URDF

from dhcal_pin.paper import factors, jacobian_check


def test_all_computations_agree(run, robot_folder):
    status, out, _ = run("check", URDF / "sim_6dof.dh.toml", "--json", "-")
    document = parse_json(out)
    assert (status, document["agree"]) == (0, True)
    assert len(document["routes"]) == 6
    assert all(route["agrees"] and route["difference"] <= route["tolerance"] for route in document["routes"])


def test_misprint_in_equation_15_is_detected(run, robot_folder, monkeypatch):
    """k1 as printed has sine and cosine of alpha exchanged, with the wrong sign."""

    def misprinted_factors(table, q):
        result = factors.error_factors(table, q)
        n = table.n_joints
        s, c, a = np.sin(table.alpha), np.cos(table.alpha), table.a
        difference = np.stack([0 * a, a * (s - c), a * (s - c)], -1)
        for i in range(n):
            tail = np.eye(4)
            for link in table.rows(q).transpose(1, 0, 2, 3)[i + 1 :]:
                tail = tail @ link
            result[:, :3, i] += np.einsum(
                "...ji,j->...i", np.broadcast_to(tail, (len(q), 4, 4))[:, :3, :3], difference[i]
            )
        return result

    monkeypatch.setattr(jacobian_check, "error_factors", misprinted_factors)
    status, out, err = run("check", URDF / "sim_6dof.dh.toml", "--json", "-")
    document = parse_json(out)
    assert (status, document["agree"]) == (1, False)
    assert not any(route["agrees"] for route in document["routes"] if route["columns"])
    assert "DISAGREES" in err
