"""PX4's device numbers: which part, on which bus, at which address.

::

    device_id = bus type (3 bits) | bus (5 bits) << 3 | address << 8 | part << 16

A gyro and an accelerometer in one chip share bus and address; older firmware gave them different parts. Source: PX4,
src/lib/drivers/device/Device.hpp and src/drivers/drv_sensor.h.
"""

from __future__ import annotations

BUSES = {1: "I2C", 2: "SPI", 3: "UAVCAN", 4: "simulation", 5: "serial"}
PARTS = {
    0x11: "LSM303D", 0x12: "LSM6DSV", 0x13: "MPU6000", 0x14: "simulated", 0x21: "MPU6000", 0x22: "L3GD20",
    0x24: "MPU9250", 0x25: "ICM-20649", 0x26: "ICM-42688-P", 0x27: "ICM-40609-D", 0x28: "ICM-20948",
    0x29: "ICM-42605", 0x2A: "ICM-42670-P", 0x2B: "IIM-42652", 0x2C: "IAM-20680HP", 0x2D: "ICM-42686-P",
    0x2E: "IIM-42653", 0x33: "MPU6050", 0x34: "ICM-45686", 0x35: "MPU6050", 0x36: "MPU6500", 0x37: "BMI270",
    0x38: "ICM-20602", 0x3A: "ICM-20608-G", 0x3C: "ICM-20689", 0x41: "BMI055", 0x42: "BMI055", 0x44: "LSM9DS1",
    0x52: "FXOS8701C", 0x54: "FXAS2100C", 0x57: "ADIS16448", 0x58: "ADIS16470", 0x59: "ADIS16477",
    0x5A: "ADIS16507", 0x5B: "SCH16T", 0x5C: "ADIS16607", 0x5D: "ADIS1650x", 0x63: "ADIS16497", 0x66: "BMI088",
    0x6A: "BMI088", 0x6C: "BMI085", 0x6D: "BMI085", 0x80: "CAN", 0x86: "CAN", 0x87: "CAN",
    0xE1: "VN-100", 0xE2: "VN-200", 0xE3: "VN-300",
}  # fmt: skip


def described(device: int | None) -> str:
    """Return a device as text: `1310988 (simulated, simulation 1, address 0x01)`."""
    if not device:
        return "no device_id"
    part = PARTS.get(device >> 16 & 0xFF, f"part 0x{device >> 16 & 0xFF:02X}")
    bus = BUSES.get(device & 0x7, "bus")
    return f"device_id {device} ({part}, {bus} {device >> 3 & 0x1F}, address 0x{device >> 8 & 0xFF:02X})"


def same_place(one: int | None, other: int | None) -> bool:
    """Return whether two devices answer at the same bus and address."""
    return bool(one and other) and (one or 0) & 0xFFFF == (other or 0) & 0xFFFF


def same_part(one: int | None, other: int | None) -> bool:
    """Return whether two devices are halves of one part, as the gyro and the accelerometer of a BMI088 on one bus."""
    name, theirs = (PARTS.get((device or 0) >> 16 & 0xFF) for device in (one, other))
    return name is not None and name == theirs and (one or 0) & 0xFF == (other or 0) & 0xFF
