"""Pictures placed as they arrive: each vehicle's newest ones, tracked and registered on the map one by one."""
