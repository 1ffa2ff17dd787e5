"""The model of a farm: right where it can be counted by hand, and slower wherever something is short."""

import pytest

from tests.laboratory.experiments.speed.farm import (
    Farm,
    Load,
    Prices,
    Server,
    cost_of,
    first_bottleneck,
    scale,
    simulate,
)

IDEAL = Farm(spread=0.0, poll_s=1e-9, running_statements=0.0, idle_statements=0.0, statements_per_s=1e12)


def test_a_server_serves_one_after_another() -> None:
    server = Server(10.0)
    assert [server.serve(at, amount) for at, amount in ((0.0, 20.0), (1.0, 10.0), (7.0, 10.0))] == [2.0, 3.0, 8.0]
    assert server.busy_s == 4.0


def test_one_worker_takes_the_sum_of_its_phases() -> None:
    farm = Farm(spread=0.0, poll_s=1e-9, measured_poll_s=0.0, job_s=10.0, job_statements=10.0, statements_per_s=10.0,
                capture_bytes=1.0, result_bytes=1.0, store_bytes_per_s=1.0)  # fmt: skip
    load = simulate(farm, 1, 3)
    assert load.heads_per_hour == pytest.approx(3600 / (10 + 1 + 3))
    assert load.efficiency == pytest.approx(10 / 14)
    assert (load.database, load.store) == pytest.approx((1 / 14, 3 / 14))


def test_a_farm_without_bounds_computes_all_the_time() -> None:
    loads = [simulate(IDEAL, workers, 5 * workers) for workers in (1, 50)]
    assert [load.efficiency for load in loads] == pytest.approx([1.0, 1.0], abs=0.15)
    assert loads[1].heads_per_hour == pytest.approx(50 * 3600 / 25.0, rel=0.15)


def test_a_narrow_store_bounds_the_heads_an_hour() -> None:
    farm = Farm(store_bytes_per_s=24e6 + 90e6)  # one head a second
    load = simulate(farm, 100, 1200)
    assert load.heads_per_hour == pytest.approx(3600, rel=0.05)
    assert load.store > 0.95
    assert first_bottleneck([simulate(farm, 4, 48), load]) == load


def test_pauses_decide_how_many_workers_a_database_bears() -> None:
    assert simulate(Farm(), 256, 3072).efficiency == 0.0, "their questions alone are more than it answers"
    assert simulate(Farm(poll_s=2.0), 256, 3072).efficiency > 0.75


def test_costs_follow_from_hours_requests_and_bytes() -> None:
    load = Load(workers=10, efficiency=1.0, heads_per_hour=1000.0, database=0.1, store=0.1)
    prices = Prices(worker_hour=1.0, database_hour=2.0, service_hour=3.0, put=0.01, get=0.0, gb_month=1.0)
    farm = Farm(result_files=2, capture_bytes=4e8, result_bytes=6e8)
    assert cost_of(2000.0, load, farm, prices) == pytest.approx(
        {"computing": 30.0, "requests": 40.0, "a month kept": 2000.0}
    )


def test_the_experiment_names_the_first_bottleneck() -> None:
    found = scale()
    figures = found["figures"]
    assert figures["workers_efficient_poll_2_s"] >= figures["workers_efficient_poll_0.25_s"] >= 8
    assert figures["usd_1000000_computing"] > 500 * figures["usd_1000_computing"]
    assert len(found["rows"]) == 16
