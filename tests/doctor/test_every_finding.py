"""Each finding that the doctor can make has a test that injects what it is about, and a line in its page."""

import importlib
import pkgutil
import re
from pathlib import Path

from resonator_daemon import doctor
from resonator_daemon.doctor.finding import Check

PAGE = Path(__file__).parents[2] / "docs" / "doctor.md"

INJECTED = {
    "port.exists": "test_port_checks.test_a_port_that_is_not_there_is_said_with_those_that_are",
    "port.permission": "test_port_checks.test_a_port_of_another_group_names_the_group",
    "port.holder": "test_port_checks.test_whoever_holds_the_port_is_named_and_this_process_is_not",
    "port.modem_manager": "test_port_checks.test_modem_manager_is_a_warning_until_a_rule_keeps_it_away",
    "port.brltty": "test_port_checks.test_brltty_is_a_warning_where_its_rules_name_the_adapter",
    "port.latency_timer": "test_port_checks.test_a_latency_timer_is_a_warning_where_it_cannot_be_shortened",
    "usb.device": "test_usb_checks.test_a_device_that_is_not_there_is_a_fault",
    "usb.autosuspend": "test_usb_checks.test_autosuspend_is_a_warning_unless_its_delay_is_endless",
    "usb.speed": "test_usb_checks.test_a_speed_that_is_too_low_for_the_frames_is_a_fault",
    "usb.hubs": "test_usb_checks.test_many_hubs_in_a_row_are_a_warning",
    "link.opens": "test_doctor_run.test_what_is_no_board_is_the_wirings",
    "board.answers": "test_doctor_run.test_what_is_no_board_is_the_wirings",
    "board.fits": "test_link_checks.test_a_board_without_its_channels_or_of_another_plate_does_not_fit",
    "board.unit": "test_link_checks.test_a_board_with_which_the_plate_was_not_calibrated_is_a_fault",
    "board.reference": "test_link_checks.test_a_reference_that_must_be_off_is_a_fault",
    "board.reset": "test_link_checks.test_a_reset_that_nobody_wanted_is_a_warning",
    "board.counts": "test_sensor_checks.test_a_board_that_does_not_count_is_the_sensors",
    "board.temperature": "test_sensor_checks.test_a_temperature_that_no_board_has_is_a_fault",
    "link.round_trip": (
        "test_link_checks.test_answers_that_wait_for_a_latency_timer_are_a_warning_unless_this_computer_is_busy"
    ),
    "link.errors": "test_sensor_checks.test_what_befalls_the_link_is_told_apart",
    "link.steady": "test_sensor_checks.test_what_befalls_the_link_is_told_apart",
    "link.overflow": "test_sensor_checks.test_what_befalls_the_link_is_told_apart",
    "host.overrun": "test_sensor_checks.test_bytes_that_the_driver_lost_are_not_the_cables_fault",
    "sensor.calibration": "test_sensor_checks.test_an_expired_calibration_is_a_warning",
    "sensor.at_rest": "test_sensor_checks.test_a_plate_that_is_pressed_is_told_whether_it_is_released_or_not",
    "sensor.channels": "test_sensor_checks.test_a_channel_that_hears_nothing_is_dead",
    "sensor.tones": "test_sensor_checks.test_a_tone_out_of_its_band_is_named",
    "sensor.noise": "test_sensor_checks.test_a_noise_floor_above_the_counters_own_is_told",
    "sensor.cross_talk": "test_sensor_checks.test_two_channels_that_are_too_much_alike_hear_each_other",
    "sensor.drift": "test_sensor_checks.test_a_drift_is_a_warning",
    "clock.source": "test_host_checks.test_a_slow_clock_source_is_a_warning",
    "clock.date": "test_host_checks.test_a_clock_at_1970_is_a_fault",
    "clock.synchronised": "test_host_checks.test_a_clock_that_nobody_keeps_is_a_warning",
    "disk.state": "test_host_checks.test_a_directory_that_cannot_be_written_is_a_fault",
    "disk.recordings": "test_host_checks.test_a_directory_that_cannot_be_written_is_a_fault",
    "disk.budget": "test_host_checks.test_too_little_room_is_a_fault_and_a_budget_beyond_the_disk_a_warning",
    "service.unit": "test_host_checks.test_a_service_needs_its_unit_and_its_rules",
    "service.rules": "test_host_checks.test_a_service_needs_its_unit_and_its_rules",
    "broker.name": "test_broker_checks.test_a_broker_that_is_not_there_is_a_fault",
    "broker.listens": "test_broker_checks.test_a_broker_that_is_not_there_is_a_fault",
    "broker.accepts": "test_broker_checks.test_a_broker_that_refuses_says_whom",
    "broker.round_trip": "test_broker_checks.test_a_broker_without_nodelay_shows_spikes",
    "daemon.runs": "test_running_daemon.test_a_daemon_that_does_not_answer_is_a_fault_unless_this_user_may_not_ask",
    "daemon.config": "test_running_daemon.test_what_a_daemon_says_is_judged",
    "daemon.link": "test_running_daemon.test_what_a_daemon_says_is_judged",
    "daemon.sensor": "test_running_daemon.test_what_a_daemon_says_is_judged",
    "daemon.broker": "test_running_daemon.test_what_a_daemon_says_is_judged",
}


def known_ids() -> set[str]:
    modules = (
        importlib.import_module(f"{doctor.__name__}.{found.name}") for found in pkgutil.iter_modules(doctor.__path__)
    )
    return {value.id for module in modules for value in vars(module).values() if isinstance(value, Check)}


def test_each_finding_is_injected_somewhere() -> None:
    assert set(INJECTED) == known_ids()
    for place in INJECTED.values():
        module, _, test = place.partition(".")
        assert callable(getattr(importlib.import_module(module), test)), place


def test_each_finding_is_in_the_page() -> None:
    assert known_ids() <= set(re.findall(r"`([a-z]+\.[a-z_]+)`", PAGE.read_text()))
