"""FMUs as slaves: one adapter per FMI version behind the one `Slave` contract."""
